"""Telling PEFT's adapters from whole models, so that one that is offered as a model gets the right advice.

Files and names: huggingface/peft, "PEFT checkpoint format" in its documentation.
"""

from pathlib import Path

from dsvla_jax.weights.readers.safetensors import read_json
from dsvla_jax.weights.stored_tensors import WeightsError

CONFIG = "adapter_config.json"
FILES = ("adapter_model.safetensors", "adapter_model.bin")


def refuse_peft_adapter(source: Path) -> None:
    """Raises WeightsError for the folder of an adapter, for one of its files, and for a model with an adapter."""
    folder = source if source.is_dir() else source.parent
    offered = source.is_dir() or source.name in (CONFIG, *FILES)
    found = [name for name in (CONFIG, *FILES) if (folder / name).is_file()]
    if not offered or not found:
        return
    config = read_json(folder / CONFIG) if CONFIG in found else {}
    base = config.get("base_model_name_or_path") or "BASE"
    raise WeightsError(
        f"{source}: an adapter of PEFT ({', '.join(found)}), which belongs to another model and is not imported by "
        f"itself; add it to its model and import the result: PeftModel.from_pretrained(AutoModelForCausalLM."
        f"from_pretrained({str(base)!r}), {str(folder)!r}).merge_and_unload().save_pretrained(MERGED)"
    )
