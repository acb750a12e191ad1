"""Sizes and switches of the network. Plain frozen dataclasses: hashable, so a model is a valid static argument."""

import dataclasses
from typing import Literal

import jax.numpy as jnp

from dsvla_jax.ranges import at_least, check_fields, more_than, require

LORA_TARGETS = ("q", "k", "v", "o", "gate", "up", "down")

COUNT = at_least(1)
EPSILON = more_than(0, at_most=1)
ROPE_THETA = at_least(1)


def _require_known(field: str, chosen: tuple[str, ...], known: tuple[str, ...]) -> None:
    unknown = sorted(set(chosen) - set(known))
    require(not unknown, field, f"some of {', '.join(known)}", ", ".join(map(repr, unknown)))


@dataclasses.dataclass(frozen=True)
class VisionConfig:
    """A CLIP vision transformer; the defaults are ViT-L/14 at 336 pixels.

    embed_width: of CLIP's joint embedding of images and text (ViT-L/14: 768), to which every output is then projected,
        as LLaMA-Adapter reads it; None for the outputs before that projection.
    """

    image_size: int = 336
    patch_size: int = 14
    width: int = 1024
    layers: int = 24
    heads: int = 16
    mlp_ratio: float = 4.0
    norm_eps: float = 1e-5
    embed_width: int | None = None

    def __post_init__(self):
        check_fields(
            self,
            "model.vision",
            image_size=COUNT,
            patch_size=COUNT,
            width=COUNT,
            layers=COUNT,
            heads=COUNT,
            mlp_ratio=more_than(0),
            norm_eps=EPSILON,
            embed_width=COUNT,
        )
        require(
            self.image_size % self.patch_size == 0,
            "model.vision.image_size",
            f"a multiple of patch_size {self.patch_size}",
            self.image_size,
        )
        require(self.width % self.heads == 0, "model.vision.width", f"a multiple of its {self.heads} heads", self.width)
        require(self.ffn >= 1, "model.vision.mlp_ratio", f"at least 1 / width {self.width}", self.mlp_ratio)

    @property
    def grid(self) -> int:
        """Patches along one side of the image."""
        return self.image_size // self.patch_size

    @property
    def num_patches(self) -> int:
        return self.grid**2

    @property
    def ffn(self) -> int:
        return round(self.width * self.mlp_ratio)


@dataclasses.dataclass(frozen=True)
class RopeScaling:
    """Llama 3.1's stretch of the rotary wavelengths beyond the context that the model was first trained with.

    A wavelength that fits less than ``low_frequency_factor`` times into ``original_context`` is multiplied by
    ``factor``; one that fits more than ``high_frequency_factor`` times is left alone; frequencies between are blended.
    The defaults are Llama 3.1's.
    """

    factor: float = 8.0
    low_frequency_factor: float = 1.0
    high_frequency_factor: float = 4.0
    original_context: int = 8192

    def __post_init__(self):
        check_fields(
            self,
            "model.language.rope_scaling",
            factor=more_than(0),
            low_frequency_factor=at_least(0),
            high_frequency_factor=more_than(0),
            original_context=COUNT,
        )
        require(
            self.high_frequency_factor > self.low_frequency_factor,
            "model.language.rope_scaling.high_frequency_factor",
            f"more than low_frequency_factor {self.low_frequency_factor}",
            self.high_frequency_factor,
        )


@dataclasses.dataclass(frozen=True)
class LanguageConfig:
    """A LLaMA decoder; the defaults are LLaMA-7B.

    explicit_head_dim: width of one head; None for width / heads.
    biases: which linear layers have one. LLaMA's have none; LLaMA-Adapter trains those of q, o, gate, up and down.
    """

    vocab_size: int = 32000
    width: int = 4096
    layers: int = 32
    heads: int = 32
    kv_heads: int = 32
    ffn: int = 11008
    rope_theta: float = 10000.0
    norm_eps: float = 1e-6
    tie_embeddings: bool = False
    explicit_head_dim: int | None = None
    rope_scaling: RopeScaling | None = None
    biases: tuple[str, ...] = ()

    def __post_init__(self):
        check_fields(
            self,
            "model.language",
            vocab_size=COUNT,
            width=COUNT,
            layers=COUNT,
            heads=COUNT,
            kv_heads=COUNT,
            ffn=COUNT,
            rope_theta=ROPE_THETA,
            norm_eps=EPSILON,
            explicit_head_dim=COUNT,
        )
        # A rotation turns pairs of numbers.
        if self.explicit_head_dim is None:
            require(
                self.width % (2 * self.heads) == 0,
                "model.language.width",
                f"a multiple of 2 * heads = {2 * self.heads}, or explicit_head_dim",
                self.width,
            )
        else:
            require(
                self.explicit_head_dim % 2 == 0,
                "model.language.explicit_head_dim",
                "an even number",
                self.explicit_head_dim,
            )
        _require_known("model.language.biases", self.biases, LORA_TARGETS)
        require(
            self.heads % self.kv_heads == 0,
            "model.language.kv_heads",
            f"a divisor of heads {self.heads}",
            self.kv_heads,
        )

    @property
    def head_dim(self) -> int:
        return self.explicit_head_dim or self.width // self.heads


@dataclasses.dataclass(frozen=True)
class VisualPromptConfig:
    """LLaMA-Adapter's way from vision outputs to prompts; the defaults are ManipLLM's, which 3DS-VLA builds on.

    width, layers, heads, ffn, rope_theta, norm_eps: of the visual blocks, transformer layers that see all tokens.
    queries: 0 makes every visual token a prompt token. Otherwise so many learned queries are read with the visual
        tokens, and only they become the prompt (LLaMA-Adapter V2: 10).
    prompted_layers: how many of the language model's layers, counted from its end, look at a prompt; None for all.
    """

    width: int = 1024
    layers: int = 16
    heads: int = 8
    ffn: int = 2816
    rope_theta: float = 10000.0
    norm_eps: float = 1e-5
    queries: int = 0
    prompted_layers: int | None = None

    def __post_init__(self):
        check_fields(
            self,
            "model.visual_prompt",
            width=COUNT,
            layers=COUNT,
            heads=COUNT,
            ffn=COUNT,
            rope_theta=ROPE_THETA,
            norm_eps=EPSILON,
            queries=at_least(0),
            prompted_layers=COUNT,
        )
        require(
            self.width % (2 * self.heads) == 0,
            "model.visual_prompt.width",
            f"a multiple of 2 * heads = {2 * self.heads}",
            self.width,
        )


@dataclasses.dataclass(frozen=True)
class LoraConfig:
    """Low-rank adapters: y = x W + (alpha / rank) x A B.

    targets: which linear layers carry one. q, k, v, o of the attentions and up, down of the MLPs exist in both towers,
        gate in the language model only.
    towers: which towers carry them.
    init: distribution of A. "kaiming" is uniform in +-1/sqrt(inputs), as peft's; "normal" has std 0.02. B is zero.
    """

    rank: int = 16
    alpha: float = 16.0
    targets: tuple[str, ...] = LORA_TARGETS
    towers: tuple[str, ...] = ("vision", "language")
    init: Literal["kaiming", "normal"] = "kaiming"

    def __post_init__(self):
        check_fields(self, "model.lora", rank=COUNT, alpha=more_than(0))
        for name, chosen, known in (
            ("targets", self.targets, LORA_TARGETS),
            ("towers", self.towers, ("vision", "language")),
        ):
            require(bool(chosen), f"model.lora.{name}", f"some of {', '.join(known)}", "none")
            _require_known(f"model.lora.{name}", chosen, known)

    @property
    def scale(self) -> float:
        return self.alpha / self.rank


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The assembled network.

    point_width: width of a 3D token; the vision tower's width, because 3D tokens enter it as they are. None means that.
    fusion: how visual tokens enter the language model. "prefix": projected, before the text, so that any model of the
        Llama family serves. "adapter": as prompts that every layer looks at in an attention of their own, behind a
        gate that starts closed (LLaMA-Adapter, the paper's lineage).
    projector: of "prefix", vision -> language width: a "linear" layer, or an "mlp" of two with GELU; LayerNorm follows.
    visual_prompt: the projection of "adapter".
    lora: None for no adapters.
    dtype: of matrix products and activations. Parameters, norms, softmax, rotations and logits are always float32.
    base_dtype: of the matrices of frozen towers. "same": as dtype. "bfloat16": also where dtype is float32. "int8":
        the kernels of their layers in 8 bits with a scale for each output (`dsvla_jax.model.quantize`).
    remat: what the backward pass computes again, a layer at a time: "none", "full" (everything), "dots" (all but the
        results of products with weights: jax's dots_with_no_batch_dims_saveable), or that policy or another by its
        name in jax.checkpoint_policies.
    attention: "by_hand" (two batched products over head-major arrays; the quickest on CPU), "fused"
        (jax.nn.dot_product_attention as XLA compiles it), "cudnn" (the same as one kernel of cuDNN's: NVIDIA, bfloat16,
        and cuDNN's limits on lengths), or "auto": "by_hand" on a CPU, "fused" elsewhere.
    scan_unroll: layers per iteration of the loop over layers. Compile time grows with it, loop overhead shrinks. With
        as many as the language model has, training also leaves out what its last layer would do for visual tokens.
    """

    vision: VisionConfig = VisionConfig()
    language: LanguageConfig = LanguageConfig()
    point_width: int | None = None
    fusion: Literal["prefix", "adapter"] = "prefix"
    projector: Literal["linear", "mlp"] = "linear"
    visual_prompt: VisualPromptConfig = VisualPromptConfig()
    lora: LoraConfig | None = None
    dtype: Literal["float32", "bfloat16"] = "float32"
    base_dtype: Literal["same", "bfloat16", "int8"] = "same"
    remat: Literal["none", "full", "dots", "dots_saveable", "dots_with_no_batch_dims_saveable"] = "none"
    attention: Literal["auto", "by_hand", "fused", "cudnn"] = "auto"
    scan_unroll: int = 1

    def __post_init__(self):
        check_fields(self, "model", point_width=COUNT, scan_unroll=COUNT)
        require(
            self.point_width in (None, self.vision.width),
            "model.point_width",
            f"the vision width {self.vision.width}, because 3D tokens enter the vision tower unprojected",
            self.point_width,
        )
        if self.fusion == "adapter":
            require(
                self.projector == "linear",
                "model.projector",
                "'linear' with fusion 'adapter', whose projection is visual_prompt",
                repr(self.projector),
            )
            require(
                self.prompted_layers <= self.language.layers,
                "model.visual_prompt.prompted_layers",
                f"at most the language model's {self.language.layers} layers",
                self.prompted_layers,
            )

    @property
    def compute_dtype(self) -> jnp.dtype:
        return jnp.dtype(self.dtype)

    @property
    def frozen_dtype(self) -> jnp.dtype:
        """Of matrices that do not learn, but for kernels in 8 bits."""
        return jnp.dtype(jnp.bfloat16) if self.base_dtype == "bfloat16" else self.compute_dtype

    @property
    def prompted_layers(self) -> int:
        """How many of the language model's last layers look at a visual prompt with fusion="adapter"."""
        chosen = self.visual_prompt.prompted_layers
        return self.language.layers if chosen is None else chosen

    def lora_for(self, tower: str) -> LoraConfig | None:
        """The adapters of one tower, None where it has none."""
        return self.lora if self.lora is not None and tower in self.lora.towers else None
