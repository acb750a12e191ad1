"""What LLaMA-Adapter's training adds to LLaMA, as ManipLLM and 3DS-VLA keep it: projection, gates, adapters, biases.

Names: clorislili/ManipLLM, train/llama/llama_adapter.py and train/llama/llama.py; its adapters are added without a
factor, so alpha is the rank. OpenGVLab/LLaMA-Adapter's own V2 has other visual blocks (timm's), which are refused.
"""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path

import jax

from dsvla_jax.checkpoints.storage import PyTree
from dsvla_jax.model.config import (
    LORA_TARGETS,
    LanguageConfig,
    LoraConfig,
    ModelConfig,
    VisionConfig,
    VisualPromptConfig,
)
from dsvla_jax.model.vla import initialize
from dsvla_jax.weights.readers.llama_consolidated import META_BLOCKS, META_LINEAR, META_NAMES, in_rotary_pairs
from dsvla_jax.weights.readers.openai_clip import CLIP_NAMES, split_in_projections
from dsvla_jax.weights.readers.peft import refuse_peft_adapter
from dsvla_jax.weights.readers.torch_files import list_tensors
from dsvla_jax.weights.stored_tensors import StoredTensor, WeightsError
from dsvla_jax.weights.towers import Place, Tower, assign, find_places, find_prefix, flat_shapes, tower_shapes

PROJECTOR_NAMES = {
    **{
        f"{name}/{ours}": f"{name}.{theirs}"
        for name in ("clip_proj", "visual_proj")
        for ours, theirs in (("kernel", "weight"), ("bias", "bias"))
    },
    **{
        f"{name}_norm/{ours}": f"{name}_norm.{theirs}"
        for name in ("clip_proj", "visual_proj")
        for ours, theirs in (("scale", "weight"), ("bias", "bias"))
    },
    **{f"visual_blocks/{ours}": f"visual_blocks.{theirs}" for ours, theirs in META_BLOCKS.items()},
    "visual_blocks_norm/scale": "visual_blocks.norm.weight",
    "visual_blocks_output/kernel": "visual_blocks.output.weight",
    "visual_query": "visual_query.weight",
    "adapter_query": "adapter_query.weight[{}]",
    "gate": "gate[{}]",
}
CLIP = "clip.visual."
GATE = re.compile(r"layers\.(\d+)\.attention\.gate")


@dataclasses.dataclass(frozen=True)
class Adapter:
    """What a file adds. language: the decoder's sizes with biases. instead: the norms and biases that it has for it.

    repeated: by tower, what it has of the towers' own weights, which is to be equal to them.
    """

    projector: Tower
    lora: Tower | None
    language: LanguageConfig
    instead: Mapping[Place, StoredTensor]
    repeated: Mapping[str, Mapping[Place, StoredTensor]]


def read_adapter(file: Path, language: LanguageConfig, vision: VisionConfig, heads: int) -> Adapter:
    """The trained parts in a PyTorch file for towers of these sizes. heads: of the visual blocks, which no file says.

    LLaMA's and CLIP's own weights may be in the file too: `Adapter.repeated`, to be compared with the towers'.
    Raises WeightsError naming file and key where anything does not fit.
    """
    refuse_peft_adapter(file)
    everything = list_tensors(file)
    prefix = find_prefix(everything, "adapter_query.weight", file)
    tensors = {key.removeprefix(prefix): tensor for key, tensor in everything.items() if key.startswith(prefix)}
    if any(".attn.qkv." in key for key in tensors):
        raise WeightsError(
            f"{file}: its visual blocks are timm's, as in LLaMA-Adapter V2; only ManipLLM's are read "
            "(visual_blocks.layers.*)"
        )
    decoder = {key.removeprefix("llama."): tensor for key, tensor in tensors.items() if key.startswith("llama.")}
    own = {key: tensor for key, tensor in tensors.items() if not key.startswith(("llama.", "clip."))}
    decoder = in_rotary_pairs(decoder, language.head_dim)

    instead = _decoder_places(decoder)
    biases = tuple(name for name in META_LINEAR if (f"layers/{name}/bias", 0) in instead)
    language = dataclasses.replace(language, biases=biases)
    gates = {int(match[1]): tensor for key, tensor in decoder.items() if (match := GATE.fullmatch(key))}
    lora = _adapters(decoder, language, file)
    known = set(META_NAMES.values())
    strange = [
        key
        for key in decoder
        if not (GATE.fullmatch(key) or "lora_" in key or key.endswith(".bias") or _unnumbered(key) in known)
    ]
    if strange:
        raise WeightsError(f"{file}: no place in this architecture for: {', '.join(sorted(strange)[:5])}")
    projector = _projector(own, gates, language, vision, heads, file)
    matrices = {ours: theirs for ours, theirs in META_NAMES.items() if not ours.endswith("/scale")}
    clip = split_in_projections({key.removeprefix(CLIP): t for key, t in tensors.items() if key.startswith(CLIP)})
    repeated = {
        "language": find_places(matrices, tower_shapes(language), decoder),
        "vision": find_places(CLIP_NAMES, tower_shapes(dataclasses.replace(vision, embed_width=None)), clip),
    }
    return Adapter(projector, lora, language, instead, repeated)


def _unnumbered(key: str) -> str:
    return re.sub(r"layers\.\d+\.", "layers.{}.", key)


def _decoder_places(decoder: Mapping[str, StoredTensor]) -> dict[Place, StoredTensor]:
    """Norms and biases of the decoder, which are trained with the adapters."""
    names = {theirs: ours for ours, theirs in META_NAMES.items() if ours.endswith("/scale")}
    names |= {f"layers.{{}}.{theirs}.bias": f"layers/{ours}/bias" for ours, theirs in META_LINEAR.items()}
    places: dict[Place, StoredTensor] = {}
    for key, tensor in decoder.items():
        if (path := names.get(_unnumbered(key))) is not None:
            number = re.match(r"layers\.(\d+)\.", key)
            places[path, None if number is None else int(number[1])] = tensor
    return places


def _adapters(decoder: Mapping[str, StoredTensor], language: LanguageConfig, file: Path) -> Tower | None:
    """The low-rank adapters of the decoder, None where it has none."""
    names: dict[str, str] = {}
    for ours, theirs in META_LINEAR.items():
        module, linear = theirs.rsplit(".", 1)
        names |= {
            f"layers/{ours}/{factor}": f"layers.{{}}.{module}.lora_{linear}_l{number}.weight"
            for factor, number in (("a", 1), ("b", 2))
        }
    tensors = {key: tensor for key, tensor in decoder.items() if ".lora_" in key}
    targets = tuple(name for name in LORA_TARGETS if names[f"layers/{name}/a"].format(0) in tensors)
    if not targets:
        return None
    first = tensors[names[f"layers/{targets[0]}/a"].format(0)]
    if len(first.shape) != 2 or not first.shape[0]:
        raise WeightsError(f"{file}: {first.key}: expected a matrix of rank x inputs, found shape {first.shape}")
    lora = LoraConfig(rank=first.shape[0], alpha=float(first.shape[0]), targets=targets, towers=("language",))
    shapes = flat_shapes(_variables(ModelConfig(language=language, lora=lora))["lora"]["language"])
    return assign(lora, shapes, names, tensors, file)


def _projector(
    own: Mapping[str, StoredTensor],
    gates: Mapping[int, StoredTensor],
    language: LanguageConfig,
    vision: VisionConfig,
    heads: int,
    file: Path,
) -> Tower:
    def shape(key: str) -> tuple[int, ...]:
        if key not in own or len(own[key].shape) != 2:
            raise WeightsError(f"{file}: wrong architecture: expected a matrix {key}")
        return own[key].shape

    queries = shape("visual_query.weight")[0] if "visual_query.weight" in own else 0
    rows = queries or 1 + vision.num_patches
    stored_rows = shape("adapter_query.weight")[0]
    count, left = divmod(stored_rows, rows)
    if left or not 0 < count <= language.layers:
        raise WeightsError(
            f"{file}: adapter_query.weight: {stored_rows} rows are not those of up to {language.layers} layers with "
            f"{rows} each, for images of {vision.image_size} pixels in patches of {vision.patch_size}; the vision "
            "tower must be the one that the file was trained with, at its size"
        )
    blocks = {int(match[1]) for key in own if (match := re.match(r"visual_blocks\.layers\.(\d+)\.", key))}
    try:
        prompt = VisualPromptConfig(
            width=shape("clip_proj.weight")[0],
            layers=len(blocks),
            heads=heads,
            ffn=shape("visual_blocks.layers.0.feed_forward.w1.weight")[0],
            queries=queries,
            prompted_layers=None if count == language.layers else count,
        )
        config = ModelConfig(vision=vision, language=language, fusion="adapter", visual_prompt=prompt)
    except ValueError as error:
        raise WeightsError(f"{file}: {error}") from error
    tensors = in_rotary_pairs(own, prompt.width // prompt.heads)
    table = tensors.pop("adapter_query.weight")
    tensors |= {f"adapter_query.weight[{i}]": table.rows(i * rows, (i + 1) * rows) for i in range(count)}
    for index, tensor in gates.items():
        place = index - (language.layers - count)
        if place >= 0:
            if tensor.shape != (1, language.heads, 1, 1):
                raise WeightsError(
                    f"{file}: {tensor.key}: expected shape {(1, language.heads, 1, 1)}, found {tensor.shape}"
                )
            tensors[f"gate[{place}]"] = dataclasses.replace(tensor, shape=(language.heads,))
    shapes = flat_shapes(_variables(config)["params"]["projector"])
    return assign(prompt, shapes, PROJECTOR_NAMES, tensors, file)


def _variables(config: ModelConfig) -> dict[str, PyTree]:
    return jax.eval_shape(lambda: initialize(config, jax.random.key(0)))
