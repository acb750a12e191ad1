"""Adapters as PEFT loads them: adapter_config.json and adapter_model.safetensors.

https://github.com/huggingface/peft, "LoRA" in its documentation.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike
from safetensors.numpy import save_file

from dsvla_jax.checkpoints.variables import StoredVariable
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.weights.writers.hugging_face import write_json

Variables = Mapping[tuple[str, ...], StoredVariable]


def write_adapters(
    folder: Path,
    tower: str,
    parts: Variables,
    names: Mapping[str, str],
    model: ModelConfig,
    dtype: DTypeLike,
    base: str | None,
) -> None:
    """Writes the adapters of a tower to a folder that is there.

    tower: "language" or "vision". parts: its variables. names: the base model's name of each, with {} for the layer.
    base: the model that the adapters belong to, a folder or a name on the Hub, for peft's AutoPeftModel.
    """
    lora = model.lora
    assert lora is not None
    # The attribute that a vision tower without projection once was in is gone from transformers 5.
    alone = tower == "vision" and model.vision.embed_width is None
    tensors, targets = {}, []
    for path, leaf in parts.items():
        if path[0] != "lora":
            continue
        module = names["/".join((*path[2:-1], "kernel"))].removesuffix(".weight")
        module = module.removeprefix("vision_model.") if alone else module
        targets.append(module.rsplit(".", 1)[-1])
        for layer, values in enumerate(leaf.read()):
            key = f"base_model.model.{module.format(layer)}.lora_{path[-1].upper()}.weight"
            tensors[key] = np.ascontiguousarray(values.T, dtype)
    save_file(tensors, folder / "adapter_model.safetensors", metadata={"format": "pt"})
    kind = "CLIPVisionModel" if alone else "CLIPVisionModelWithProjection"
    clip = {"base_model_class": kind, "parent_library": "transformers.models.clip.modeling_clip"}
    write_json(
        folder / "adapter_config.json",
        {
            "peft_type": "LORA",
            "task_type": "CAUSAL_LM" if tower == "language" else None,
            "auto_mapping": None if tower == "language" else clip,
            "base_model_name_or_path": base,
            "r": lora.rank,
            "lora_alpha": int(lora.alpha) if lora.alpha == int(lora.alpha) else lora.alpha,
            "target_modules": sorted(set(targets)),
            "lora_dropout": 0.0,
            "bias": "none",
            "use_rslora": False,
            "use_dora": False,
            "fan_in_fan_out": False,
            "inference_mode": True,
        },
    )
