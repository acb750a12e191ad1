"""What the config.json of a Hugging Face checkpoint says about its LLaMA decoder or CLIP vision tower.

Fields and their defaults: transformers' LlamaConfig and CLIPVisionConfig, which leave out of the file what is default.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dsvla_jax.model.config import LanguageConfig, RopeScaling, VisionConfig
from dsvla_jax.weights.safetensors import read_json
from dsvla_jax.weights.tensors import WeightsError

CONFIG = "config.json"


@dataclasses.dataclass(frozen=True)
class Section:
    """The part of a config.json that describes one tower."""

    file: Path
    values: Mapping[str, Any]

    def number(self, name: str, default: float) -> float:
        """A numeric field; absent and null mean the default."""
        value = self.values.get(name)
        if value is None:
            return default
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise WeightsError(f"{self.file}: {name}: expected a number, found {value!r}")
        return value

    def integer(self, name: str, default: int) -> int:
        """A field that counts something."""
        value = self.number(name, default)
        if value != int(value) or value <= 0:
            raise WeightsError(f"{self.file}: {name}: expected a positive integer, found {value!r}")
        return int(value)

    def require(self, name: str, supported: Any) -> None:
        """Refuses a variant of the architecture that this project does not compute."""
        value = self.values.get(name, supported)
        if value != supported:
            raise WeightsError(f"{self.file}: {name}: only {supported!r} is supported, found {value!r}")


def _section(folder: Path, kind: str, inside: str) -> Section:
    """The section with model_type ``kind``: the whole file, or what the field ``inside`` holds."""
    file = folder / CONFIG
    config = read_json(file)
    nested = config.get(inside)
    if config.get("model_type") == kind:
        return Section(file, config)
    # Old files of enclosing models leave out the type of what they enclose; CLIP's can only be CLIP's.
    default = kind if config.get("model_type") == "clip" else None
    if isinstance(nested, Mapping) and nested.get("model_type", default) == kind:
        return Section(file, nested)
    found = f"{nested.get('model_type')!r} in {inside}" if isinstance(nested, Mapping) else "no such section"
    raise WeightsError(
        f"{file}: wrong architecture: expected model_type {kind!r} (or {inside} with it), "
        f"found {config.get('model_type')!r} and {found}"
    )


def read_language_config(folder: Path) -> LanguageConfig:
    """The sizes of a LLaMA decoder. Raises WeightsError where the architecture is another one."""
    section = _section(folder, "llama", "text_config")
    section.require("hidden_act", "silu")
    biases = ("q", "k", "v", "o") if section.values.get("attention_bias") else ()
    biases += ("gate", "up", "down") if section.values.get("mlp_bias") else ()
    base = LanguageConfig()
    width = section.integer("hidden_size", base.width)
    heads = section.integer("num_attention_heads", base.heads)
    head_dim = section.integer("head_dim", width // heads)
    theta, scaling = _rope(section)
    try:
        return LanguageConfig(
            vocab_size=section.integer("vocab_size", base.vocab_size),
            width=width,
            layers=section.integer("num_hidden_layers", base.layers),
            heads=heads,
            kv_heads=section.integer("num_key_value_heads", heads),
            ffn=section.integer("intermediate_size", base.ffn),
            rope_theta=theta,
            norm_eps=section.number("rms_norm_eps", base.norm_eps),
            tie_embeddings=bool(section.values.get("tie_word_embeddings", False)),
            explicit_head_dim=None if head_dim * heads == width else head_dim,
            rope_scaling=scaling,
            biases=biases,
        )
    except ValueError as error:
        raise WeightsError(f"{section.file}: {error}") from error


def _rope(section: Section) -> tuple[float, RopeScaling | None]:
    """The base of the rotary frequencies and their scaling, from the old fields or the new `rope_parameters`."""
    values = section.values.get("rope_parameters") or section.values.get("rope_scaling") or {}
    if not isinstance(values, Mapping):
        raise WeightsError(f"{section.file}: rope_parameters: expected an object, found {values!r}")
    rope = Section(section.file, values)
    theta = float(rope.number("rope_theta", section.number("rope_theta", 10000.0)))
    kind = values.get("rope_type", values.get("type", "default"))
    rope.require("partial_rotary_factor", 1.0)
    if kind == "default":
        return theta, None
    if kind != "llama3":
        raise WeightsError(f"{section.file}: rope_type: supported are 'default' and 'llama3', found {kind!r}")
    names = ("factor", "low_freq_factor", "high_freq_factor", "original_max_position_embeddings")
    missing = [name for name in names if name not in values]
    if missing:
        raise WeightsError(f"{section.file}: rope_type 'llama3' needs {', '.join(missing)}")
    factor, low, high = (float(rope.number(name, 0)) for name in names[:3])
    try:
        return theta, RopeScaling(factor, low, high, rope.integer(names[3], 0))
    except ValueError as error:
        raise WeightsError(f"{section.file}: {error}") from error


def read_vision_config(folder: Path) -> VisionConfig:
    """The sizes of a CLIP vision tower. Raises WeightsError where the architecture is another one."""
    section = _section(folder, "clip_vision_model", "vision_config")
    section.require("hidden_act", "quick_gelu")
    section.require("num_channels", 3)
    width = section.integer("hidden_size", 768)
    try:
        return VisionConfig(
            image_size=section.integer("image_size", 224),
            patch_size=section.integer("patch_size", 32),
            width=width,
            layers=section.integer("num_hidden_layers", 12),
            heads=section.integer("num_attention_heads", 12),
            mlp_ratio=section.integer("intermediate_size", 3072) / width,
            norm_eps=section.number("layer_norm_eps", 1e-5),
        )
    except ValueError as error:
        raise WeightsError(f"{section.file}: {error}") from error
