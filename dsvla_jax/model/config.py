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
    """A CLIP vision transformer; the defaults are the paper's ViT-L/14 at 336 pixels."""

    image_size: int = 336
    """Pixels a side of the square image; a multiple of patch_size."""
    patch_size: int = 14
    """Pixels a side of one patch."""
    width: int = 1024
    """Channels of a token; a multiple of heads."""
    layers: int = 24
    """Transformer layers."""
    heads: int = 16
    """Attention heads of each layer."""
    mlp_ratio: float = 4.0
    """Hidden width of each layer's MLP, as a multiple of width."""
    norm_eps: float = 1e-5
    """Added to the variance in every LayerNorm."""
    embed_width: int | None = None
    """Width of CLIP's joint embedding of images and text (ViT-L/14: 768), to which every output is projected, as
    LLaMA-Adapter reads it; None keeps the outputs before that projection."""

    def __post_init__(self) -> None:
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
        """N: patches of one image."""
        return self.grid**2

    @property
    def ffn(self) -> int:
        """Hidden width of a layer's MLP."""
        return round(self.width * self.mlp_ratio)


@dataclasses.dataclass(frozen=True)
class RopeScaling:
    """Llama 3.1's stretch of the rotary wavelengths beyond the context that the model was first trained with.

    Wavelengths between the two limits are blended. The defaults are Llama 3.1's.
    """

    factor: float = 8.0
    """Multiplies the wavelengths that fit less than low_frequency_factor times into original_context."""
    low_frequency_factor: float = 1.0
    """Wavelengths that fit fewer times into original_context are multiplied by factor."""
    high_frequency_factor: float = 4.0
    """Wavelengths that fit more often into original_context stay as they are; more than low_frequency_factor."""
    original_context: int = 8192
    """Tokens of the context that the model was first trained with."""

    def __post_init__(self) -> None:
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
    """A LLaMA decoder; the defaults are the paper's LLaMA-7B."""

    vocab_size: int = 32000
    """Tokens in the vocabulary."""
    width: int = 4096
    """Channels of a token; a multiple of 2 * heads unless explicit_head_dim is given."""
    layers: int = 32
    """Transformer layers."""
    heads: int = 32
    """Attention heads of the queries."""
    kv_heads: int = 32
    """Attention heads of keys and values, shared by groups of query heads; a divisor of heads."""
    ffn: int = 11008
    """Hidden width of each layer's gated MLP."""
    rope_theta: float = 10000.0
    """Base of the rotary frequencies."""
    norm_eps: float = 1e-6
    """Added to the mean square in every RMSNorm."""
    tie_embeddings: bool = False
    """Use the token embedding as the output matrix too."""
    explicit_head_dim: int | None = None
    """Width of one head, even; None for width / heads."""
    rope_scaling: RopeScaling | None = None
    """Llama 3.1's stretch of the rotary wavelengths; None leaves them as they are."""
    biases: tuple[str, ...] = ()
    """Linear layers with a bias, among q, k, v, o, gate, up and down. LLaMA has none; LLaMA-Adapter trains those of q,
    o, gate, up and down."""

    def __post_init__(self) -> None:
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
            explicit_head_dim=at_least(1, at_most=8192),
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
        """D: width of a head."""
        return self.explicit_head_dim or self.width // self.heads


@dataclasses.dataclass(frozen=True)
class VisualPromptConfig:
    """LLaMA-Adapter's way from vision outputs to prompts; the defaults are ManipLLM's, which 3DS-VLA builds on."""

    width: int = 1024
    """Channels of the visual blocks, transformer layers that see all visual tokens; a multiple of 2 * heads."""
    layers: int = 16
    """Visual blocks."""
    heads: int = 8
    """Attention heads of each visual block."""
    ffn: int = 2816
    """Hidden width of the gated MLP of each visual block."""
    rope_theta: float = 10000.0
    """Base of the rotary frequencies in the visual blocks."""
    norm_eps: float = 1e-5
    """Added to the mean square in every RMSNorm of the visual blocks."""
    queries: int = 0
    """Learned tokens that are read with the visual tokens and alone become the prompt (LLaMA-Adapter V2: 10); 0 makes
    every visual token a prompt token."""
    prompted_layers: int | None = None
    """Layers of the language model, counted from its end, that attend to a prompt; None for all."""

    def __post_init__(self) -> None:
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
    """Low-rank adapters: y = x W + (alpha / rank) x A B, with B zero at the start."""

    rank: int = 16
    """Rank of each adapter."""
    alpha: float = 16.0
    """Scale of the adapters: their product is multiplied by alpha / rank."""
    targets: tuple[str, ...] = LORA_TARGETS
    """Linear layers with an adapter: q, k, v, o of the attentions and up, down of the MLPs in both towers, gate in the
    language model only."""
    towers: tuple[str, ...] = ("vision", "language")
    """Towers with adapters: vision, language or both."""
    init: Literal["kaiming", "normal"] = "kaiming"
    """Distribution of A: kaiming is uniform in +-1/sqrt(inputs), as in peft; normal has standard deviation 0.02."""

    def __post_init__(self) -> None:
        check_fields(self, "model.lora", rank=COUNT, alpha=more_than(0))
        for name, chosen, known in (
            ("targets", self.targets, LORA_TARGETS),
            ("towers", self.towers, ("vision", "language")),
        ):
            require(bool(chosen), f"model.lora.{name}", f"some of {', '.join(known)}", "none")
            _require_known(f"model.lora.{name}", chosen, known)

    @property
    def scale(self) -> float:
        """The factor of an adapter's product A B."""
        return self.alpha / self.rank


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The assembled network."""

    vision: VisionConfig = VisionConfig()
    """The vision tower."""
    language: LanguageConfig = LanguageConfig()
    """The language model."""
    cameras: int = 1
    """Cameras whose pictures it reads at a time, 1 to 4; as many as data.cameras. With more than one, the vision tower
    has an embedding for each."""
    point_width: int | None = None
    """Channels of a 3D token; must be the vision tower's width, because 3D tokens enter it as they are. None means
    that."""
    fusion: Literal["prefix", "adapter"] = "prefix"
    """How visual tokens enter the language model. prefix: projected and put before the text, which works with any model
    of the Llama family. adapter: as prompts that every layer attends to separately, through a gate that starts closed
    (LLaMA-Adapter, the paper's lineage)."""
    projector: Literal["linear", "mlp"] = "linear"
    """Projector from vision to language width with fusion prefix: one linear layer, or an mlp of two with GELU;
    LayerNorm follows."""
    visual_prompt: VisualPromptConfig = VisualPromptConfig()
    """The projector with fusion adapter."""
    lora: LoraConfig | None = None
    """Low-rank adapters; None for none."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of matrix products and activations. Parameters, norms, softmax, rotations and logits are always float32."""
    base_dtype: Literal["same", "bfloat16", "int8"] = "same"
    """Type of the matrices of frozen towers. same: as dtype. bfloat16: also if dtype is float32. int8: kernels of their
    layers in 8 bits, with one scale for each output."""
    remat: Literal["none", "full", "dots", "dots_saveable", "dots_with_no_batch_dims_saveable"] = "none"
    """What the backward pass computes again, a layer at a time: none, full (everything), or dots (all but the products
    with weights, jax's dots_with_no_batch_dims_saveable). The other values are policies of jax.checkpoint_policies."""
    attention: Literal["auto", "explicit", "fused", "cudnn"] = "auto"
    """explicit: two batched products over head-major arrays, the fastest on CPU. fused: jax.nn.dot_product_attention as
    XLA compiles it. cudnn: the same as one cuDNN kernel (NVIDIA, bfloat16, cuDNN's limits on lengths). auto: explicit
    on a CPU, fused elsewhere. A policy of a run with cudnn acts with fused where there is no such GPU."""
    scan_unroll: int = 1
    """Layers per iteration of the loop over layers. More layers cost compile time and save loop overhead. With all
    layers of the language model, training also skips what its last layer would compute for visual tokens."""

    def __post_init__(self) -> None:
        check_fields(self, "model", cameras=at_least(1, at_most=4), point_width=COUNT, scan_unroll=COUNT)
        require(
            self.point_width in (None, self.vision.width),
            "model.point_width",
            f"the vision width {self.vision.width}, because 3D tokens enter the vision tower unprojected",
            self.point_width,
        )
        kernel = self.attention == "cudnn" and self.dtype != "bfloat16"
        require(not kernel, "model.dtype", "bfloat16 with attention 'cudnn'", self.dtype)
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
        """The dtype that the layers compute in."""
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
