"""What the config.json of a Hugging Face checkpoint says about its LLaMA decoder or CLIP vision tower.

Fields and their defaults: transformers' LlamaConfig and CLIPVisionConfig, which leave out of the file what is default.
"""

import dataclasses
import math
from collections.abc import Collection, Mapping
from pathlib import Path

from dsvla_jax.encoding.encode import CLIP_MEAN, CLIP_STD
from dsvla_jax.json_values import Json
from dsvla_jax.model.config import LanguageConfig, RopeScaling, VisionConfig
from dsvla_jax.weights.readers.safetensors import read_json
from dsvla_jax.weights.stored_tensors import WeightsError

CONFIG = "config.json"
# How pictures were prepared: a file, and the field in it, or none.
PREPROCESSORS = {"preprocessor_config.json": None, "processor_config.json": "image_processor"}
VISION_FIELDS = (
    "hidden_act",
    "num_channels",
    "image_size",
    "patch_size",
    "hidden_size",
    "num_hidden_layers",
    "num_attention_heads",
    "intermediate_size",
    "layer_norm_eps",
)

# What relatives of LLaMA compute otherwise, by the field that says so, and the value with which they do not.
# transformers' LlamaForCausalLM would leave these fields unread.
NO_RELATIVE = {
    "hidden_act": "silu",
    "partial_rotary_factor": 1.0,
    "sliding_window": 0,
    "use_sliding_window": False,
    "attention_chunk_size": 0,
    "attn_logit_softcapping": 0,
    "final_logit_softcapping": 0,
    "logit_scale": 1.0,
    "logits_scaling": 1.0,
    "embedding_multiplier": 1.0,
    "residual_multiplier": 1.0,
    "attention_multiplier": 1.0,
    "query_pre_attn_scalar": 0,
    "clip_qkv": 0,
    "alibi": False,
    "use_qk_norm": False,
    "qk_layernorm": False,
    "parallel_attn": False,
    "use_bidirectional_attention": False,
    "num_local_experts": 0,
    "num_experts": 0,
    "quantization_config": {},
}
# By rope_type, what a rope_scaling may say.
ROPE = {
    "default": (),
    "llama3": ("factor", "low_freq_factor", "high_freq_factor", "original_max_position_embeddings"),
}


@dataclasses.dataclass(frozen=True)
class Section:
    """The part of a config.json that describes one tower."""

    file: Path
    values: Mapping[str, Json]

    def number(self, name: str, default: float) -> float:
        """A numeric field; absent and null mean the default."""
        value = self.values.get(name)
        if value is None:
            return default
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise WeightsError(f"{self.file}: {name}: expected a number, found {value!r}")
        return value

    def positive(self, name: str, default: float) -> float:
        """A numeric field above 0."""
        value = self.number(name, default)
        if value <= 0:
            raise WeightsError(f"{self.file}: {name}: expected a positive number, found {value!r}")
        return float(value)

    def integer(self, name: str, default: int) -> int:
        """A field that counts something."""
        value = self.number(name, default)
        if value != int(value) or value <= 0:
            raise WeightsError(f"{self.file}: {name}: expected a positive integer, found {value!r}")
        return int(value)

    def flag(self, name: str) -> bool:
        """A field that is true or false; absent and null mean false."""
        value = self.values.get(name)
        if value is not None and not isinstance(value, bool):
            raise WeightsError(f"{self.file}: {name}: expected true or false, found {value!r}")
        return bool(value)

    def require(self, name: str, supported: Json) -> None:
        """Refuses a variant of the architecture that this project does not compute; absent and null mean none."""
        value = self.values.get(name)
        if value not in (None, supported):
            raise WeightsError(f"{self.file}: {name}: only {supported!r} is supported, found {value!r}")

    def require_all(self, neutral: Mapping[str, Json]) -> None:
        """Refuses every field that has another value than the one with which it changes nothing."""
        for name, value in neutral.items():
            self.require(name, value)

    def only(self, names: Collection[str], what: str) -> None:
        """Refuses a field of a name that is not among those that are read or change nothing; null means absent."""
        if unknown := sorted(name for name, value in self.values.items() if name not in names and value is not None):
            found = ", ".join(f"{name}: {self.values[name]!r}" for name in unknown)
            raise WeightsError(f"{self.file}: {what}: expected only {', '.join(sorted(names))}, found {found}")


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
    unused = ("sliding_window",) if section.values.get("use_sliding_window") is False else ()
    section.require_all({name: value for name, value in NO_RELATIVE.items() if name not in unused})
    _require_same_layers(section)
    biases = ("q", "k", "v", "o") if section.flag("attention_bias") else ()
    biases += ("gate", "up", "down") if section.flag("mlp_bias") else ()
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
            norm_eps=section.positive("rms_norm_eps", base.norm_eps),
            tie_embeddings=section.flag("tie_word_embeddings"),
            explicit_head_dim=None if head_dim * heads == width else head_dim,
            rope_scaling=scaling,
            biases=biases,
        )
    except ValueError as error:
        raise WeightsError(f"{section.file}: {error}") from error


def _rope(section: Section) -> tuple[float, RopeScaling | None]:
    """The base of the rotary frequencies and their scaling, from the old fields or the new `rope_parameters`."""
    said = [value for name in ("rope_scaling", "rope_parameters") if (value := section.values.get(name))]
    if len(said) == 2 and said[0] != said[1]:
        raise WeightsError(f"{section.file}: rope_scaling and rope_parameters differ: keep the one that holds")
    values = said[0] if said else {}
    if not isinstance(values, Mapping):
        raise WeightsError(f"{section.file}: rope_parameters: expected an object, found {values!r}")
    rope = Section(section.file, values)
    theta = rope.positive("rope_theta", section.positive("rope_theta", 10000.0))
    kind = values.get("rope_type", values.get("type", "default"))
    rope.require("partial_rotary_factor", 1.0)
    names = ROPE.get(kind) if isinstance(kind, str) else None
    if names is None:
        raise WeightsError(f"{section.file}: rope_type: supported are {' and '.join(map(repr, ROPE))}, found {kind!r}")
    rope.only(("rope_theta", "rope_type", "type", "partial_rotary_factor", *names), f"rope_type {kind!r}")
    if not names:
        return theta, None
    missing = [name for name in names if name not in values]
    if missing:
        raise WeightsError(f"{section.file}: rope_type 'llama3' needs {', '.join(missing)}")
    section.require(names[3], values[names[3]])
    factor, low, high = (rope.positive(name, 0) for name in names[:3])
    try:
        return theta, RopeScaling(factor, low, high, rope.integer(names[3], 0))
    except ValueError as error:
        raise WeightsError(f"{section.file}: {error}") from error


def _require_same_layers(section: Section) -> None:
    """Refuses layers that are not all alike, and code of the checkpoint's own."""
    kinds = section.values.get("layer_types") or []
    kinds = kinds if isinstance(kinds, list) else [kinds]
    if other := sorted({repr(kind) for kind in kinds} - {"'full_attention'"}):
        raise WeightsError(f"{section.file}: layer_types: only 'full_attention' is supported, found {', '.join(other)}")
    own = section.values.get("auto_map")
    if models := [name for name in (own if isinstance(own, dict) else ()) if name.startswith("AutoModel")]:
        raise WeightsError(
            f"{section.file}: auto_map: {', '.join(models)}: the checkpoint brings code of its own, which is not run; "
            "take auto_map out of a copy of the file if transformers' own LLaMA computes the same"
        )


def read_vision_config(folder: Path) -> VisionConfig:
    """The sizes of a CLIP vision tower. Raises WeightsError where the architecture is another one."""
    section = _section(folder, "clip_vision_model", "vision_config")
    # Old files say everything twice, and transformers takes this field's word.
    older = read_json(folder / CONFIG).get("vision_config_dict")
    if isinstance(older, Mapping):
        for name in VISION_FIELDS:
            if (value := older.get(name)) is not None:
                section.require(name, value)
        section = Section(section.file, {**older, **section.values})
    section.require("hidden_act", "quick_gelu")
    section.require("num_channels", 3)
    _require_normalisation(folder)
    width = section.integer("hidden_size", 768)
    try:
        return VisionConfig(
            image_size=section.integer("image_size", 224),
            patch_size=section.integer("patch_size", 32),
            width=width,
            layers=section.integer("num_hidden_layers", 12),
            heads=section.integer("num_attention_heads", 12),
            mlp_ratio=section.integer("intermediate_size", 3072) / width,
            norm_eps=section.positive("layer_norm_eps", 1e-5),
        )
    except ValueError as error:
        raise WeightsError(f"{section.file}: {error}") from error


def _require_normalisation(folder: Path) -> None:
    """Refuses a tower that learned from pictures of another scale than `dsvla_jax.encoding` gives them."""
    for name, inside in PREPROCESSORS.items():
        if not (folder / name).is_file():
            continue
        values = read_json(folder / name)
        values = values if inside is None else values.get(inside)
        section = Section(folder / name, values if isinstance(values, Mapping) else {})
        section.require("do_normalize", True)
        section.require("do_rescale", True)
        for field, ours in (("image_mean", CLIP_MEAN), ("image_std", CLIP_STD), ("rescale_factor", (1 / 255,))):
            found = section.values.get(field)
            numbers = found if isinstance(found, list) else [found]
            if found is not None and [_rounded(number) for number in numbers] != [_rounded(number) for number in ours]:
                raise WeightsError(
                    f"{section.file}: {field}: only CLIP's {', '.join(f'{number:.4g}' for number in ours)} is "
                    f"supported, found {found!r}"
                )


def _rounded(number: Json) -> Json:
    return round(number, 4) if isinstance(number, float) else number
