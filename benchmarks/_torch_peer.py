"""The same network in PyTorch, from transformers and peft: the peer of train_step_speed (not a check of its own)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import peft  # pyright: ignore[reportMissingImports]
import torch  # pyright: ignore[reportMissingImports]
import transformers  # pyright: ignore[reportMissingImports]
from flax import traverse_util

from dsvla_jax.model.config import ModelConfig
from dsvla_jax.types import ModelInputs, named_arrays
from dsvla_jax.weights.readers.hugging_face import CLIP_NAMES, LLAMA_NAMES, LM_HEAD
from dsvla_jax.weights.towers import AXES
from dsvla_jax.weights.writers.hugging_face import language_json, vision_json


class TorchVLA(torch.nn.Module):
    """`dsvla_jax.model.vla.VLA` with fusion "prefix" and a linear projector."""

    def __init__(self, config: ModelConfig, variables: Mapping[str, Any]):
        super().__init__()
        self.vision = transformers.CLIPVisionModel(
            transformers.CLIPVisionConfig(**vision_json(config.vision, "float32"))
        )
        self.language = transformers.LlamaForCausalLM(
            transformers.LlamaConfig(**language_json(config.language, "float32"))
        )
        width = config.language.width
        self.projector = torch.nn.Sequential(
            torch.nn.Linear(config.vision.width, width), torch.nn.LayerNorm(width, eps=1e-5)
        )
        if config.lora is not None:
            names = {"vision": CLIP_NAMES, "language": LLAMA_NAMES}
            for tower, theirs in names.items():
                adapted = variables["lora"][tower]["layers"]
                targets = [theirs[f"layers/{name}/kernel"].rsplit(".", 2)[-2] for name in adapted]
                settings = peft.LoraConfig(r=config.lora.rank, lora_alpha=config.lora.alpha, target_modules=targets)
                setattr(self, tower, peft.get_peft_model(getattr(self, tower), settings).base_model.model)
            for parameter in self.projector.parameters():
                parameter.requires_grad_(True)
        self.copy(variables)

    def copy(self, variables: Mapping[str, Any]) -> None:
        """Takes over our weights."""
        ours = as_torch(variables)
        parameters = dict(self.named_parameters())
        if set(ours) != set(parameters):
            raise ValueError(f"parameters differ: {sorted(set(ours) ^ set(parameters))[:5]}")
        with torch.no_grad():
            for name, parameter in parameters.items():
                parameter.copy_(torch.from_numpy(ours[name].copy()))

    def forward(self, inputs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Logits of the text positions."""
        vision, language = self.vision, self.language
        tokens_2d = vision.embeddings(inputs["images"])
        tokens_3d = inputs["point_tokens"] + vision.embeddings.position_embedding.weight[1 + inputs["point_patches"]]
        x = vision.pre_layrnorm(torch.cat([tokens_2d, tokens_3d], dim=1))
        x = vision.post_layernorm(vision.encoder(inputs_embeds=x).last_hidden_state)
        text = language.model.embed_tokens(inputs["text.tokens"])
        x = torch.cat([self.projector(x), text], dim=1)
        hidden = language.model(inputs_embeds=x, use_cache=False).last_hidden_state
        return language.lm_head(hidden[:, -text.shape[1] :])

    def loss(self, inputs: Mapping[str, torch.Tensor], answer: torch.Tensor) -> torch.Tensor:
        """Mean cross-entropy over the answer's tokens."""
        logits = self(inputs)[:, :-1][answer[:, 1:]]
        return torch.nn.functional.cross_entropy(logits, inputs["text.tokens"][:, 1:][answer[:, 1:]])


def as_torch(variables: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Our variables by the names and in the layouts of `TorchVLA`."""
    adapted = variables.get("lora", {})
    result = {}
    for path, leaf in traverse_util.flatten_dict(variables).items():
        collection, tower, *rest = path
        values, ours = np.asarray(leaf), "/".join(rest)
        if tower == "projector":
            name = {"linear": "0", "norm": "1"}[rest[0]] + {"bias": ".bias"}.get(rest[1], ".weight")
            result[f"projector.{name}"] = values.T
            continue
        names, prefix = (CLIP_NAMES, "vision.") if tower == "vision" else (LLAMA_NAMES, "language.model.")
        layers = range(len(values)) if rest[0] == "layers" else [None]
        for layer in layers:
            value = values if layer is None else values[layer]
            if collection == "lora":
                module = names["/".join([*rest[:-1], "kernel"])].removesuffix(".weight")
                key, value = f"{module}.lora_{rest[-1].upper()}.default.weight", value.T
            elif ours == "output":
                key, value, prefix = LM_HEAD, value.T, "language."
            else:
                key, axes = names[ours], AXES.get(rest[-1])
                value = value if axes is None else value.transpose(np.argsort(axes))
                if len(rest) > 2 and rest[1] in adapted.get(tower, {}).get("layers", {}):
                    module, kind = key.rsplit(".", 1)
                    key = f"{module}.base_layer.{kind}"
            result[prefix + key.format(layer)] = np.ascontiguousarray(value)
    return result


def torch_inputs(inputs: ModelInputs) -> dict[str, torch.Tensor]:
    """Our batch of one camera, its image with channels first."""
    arrays = {name: np.array(value) for name, value in named_arrays(inputs).items()}
    tensors = {
        name: torch.from_numpy(value if value.dtype != np.int32 else value.astype(np.int64))
        for name, value in arrays.items()
    }
    return tensors | {"images": tensors["images"][:, 0].permute(0, 3, 1, 2).contiguous()}
