"""Folders that `transformers` opens: config.json, shards of safetensors, tokenizer.json. Reading them is elsewhere.

Fields and names are those that every version of transformers reads, as published checkpoints have them.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file
from tokenizers import AddedToken, Regex, models, normalizers, pre_tokenizers, processors
from tokenizers import Tokenizer as FastTokenizer

from dsvla_jax.encoding.text import Tokenizer, WordTokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.json_values import Json
from dsvla_jax.model.config import LanguageConfig, VisionConfig
from dsvla_jax.weights.readers.safetensors import INDEX, SINGLE


def language_json(config: LanguageConfig, dtype: str) -> dict[str, Json]:
    """The config.json of a LlamaForCausalLM, without the ids of special tokens.

    Raises UserError where some but not all layers of the attention, or of the MLP, have biases: it has no such model.
    """
    attention, mlp = ({*group} & {*config.biases} for group in (("q", "k", "v", "o"), ("gate", "up", "down")))
    if len(attention) not in (0, 4) or len(mlp) not in (0, 3):
        raise UserError(
            f"the decoder has biases in {', '.join(config.biases)} only, as LLaMA-Adapter trains them; "
            "no LlamaForCausalLM has, so it cannot be exported as one"
        )
    scaling = config.rope_scaling
    fields: dict[str, Json] = {
        "architectures": ["LlamaForCausalLM"],
        "model_type": "llama",
        "hidden_act": "silu",
        "attention_bias": bool(attention),
        "mlp_bias": bool(mlp),
        "vocab_size": config.vocab_size,
        "hidden_size": config.width,
        "num_hidden_layers": config.layers,
        "num_attention_heads": config.heads,
        "num_key_value_heads": config.kv_heads,
        "head_dim": config.head_dim,
        "intermediate_size": config.ffn,
        "rms_norm_eps": config.norm_eps,
        "tie_word_embeddings": config.tie_embeddings,
        "rope_theta": config.rope_theta,
        "rope_scaling": None,
        "torch_dtype": dtype,
    }
    if scaling is not None:
        fields["rope_scaling"] = {
            "rope_type": "llama3",
            "factor": scaling.factor,
            "low_freq_factor": scaling.low_frequency_factor,
            "high_freq_factor": scaling.high_frequency_factor,
            "original_max_position_embeddings": scaling.original_context,
        }
        fields["max_position_embeddings"] = round(scaling.original_context * scaling.factor)
    return fields


def vision_json(config: VisionConfig, dtype: str) -> dict[str, Json]:
    """The config.json of a CLIPVisionModel; with CLIP's projection, of a CLIPVisionModelWithProjection."""
    projected = config.embed_width is not None
    fields: dict[str, Json] = {
        "architectures": ["CLIPVisionModelWithProjection" if projected else "CLIPVisionModel"],
        "model_type": "clip_vision_model",
        "hidden_act": "quick_gelu",
        "num_channels": 3,
        "image_size": config.image_size,
        "patch_size": config.patch_size,
        "hidden_size": config.width,
        "num_hidden_layers": config.layers,
        "num_attention_heads": config.heads,
        "intermediate_size": config.ffn,
        "layer_norm_eps": config.norm_eps,
        "torch_dtype": dtype,
    }
    return fields | ({"projection_dim": config.embed_width} if projected else {})


def write_json(file: Path, content: Mapping[str, object]) -> None:
    """Writes an object as JSON."""
    file.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def write_tensors(
    folder: Path, sizes: Mapping[str, int], tensors: Iterable[tuple[str, np.ndarray]], shard_bytes: float
) -> None:
    """Writes named tensors in as many files as keep each within ``shard_bytes``, with an index where there are several.

    sizes: bytes of every tensor, in the order in which ``tensors`` yields them: no more than one file's are in memory.
    """
    shards: list[list[str]] = []
    filled = 0.0
    for key, size in sizes.items():
        if not shards or filled + size > shard_bytes:
            shards.append([])
            filled = 0
        shards[-1].append(key)
        filled += size
    names = [f"model-{i:05}-of-{len(shards):05}.safetensors" for i in range(1, len(shards) + 1)]
    if len(shards) == 1:
        names = [SINGLE]
    stream: Iterator[tuple[str, np.ndarray]] = iter(tensors)
    for name, keys in zip(names, shards, strict=True):
        save_file(dict(islice(stream, len(keys))), folder / name, metadata={"format": "pt"})
    if len(shards) > 1:
        where = {key: name for name, keys in zip(names, shards, strict=True) for key in keys}
        write_json(folder / INDEX, {"metadata": {"total_size": sum(sizes.values())}, "weight_map": where})


def write_tokenizer(folder: Path, tokenizer: Tokenizer) -> dict[str, int]:
    """Writes a tokenizer as AutoTokenizer opens it; returns its special ids as config.json names them."""
    if isinstance(tokenizer, WordTokenizer):
        _write_word_tokenizer(folder, tokenizer)
    else:
        tokenizer.save(folder)
    return {"pad_token_id": tokenizer.pad_id, "bos_token_id": tokenizer.bos_id, "eos_token_id": tokenizer.eos_id}


def _write_word_tokenizer(folder: Path, tokenizer: WordTokenizer) -> None:
    """A word-level vocabulary as a file of the `tokenizers` library.

    Its ids are those of `WordTokenizer.encode` behind the begin-of-sequence token. An integer without a token is
    <unk> there, where ours is an error.
    """
    ids = {piece: token for token, piece in enumerate(tokenizer.pieces)}
    special = {
        "pad_token": tokenizer.pad_id,
        "unk_token": tokenizer.unk_id,
        "bos_token": tokenizer.bos_id,
        "eos_token": tokenizer.eos_id,
    }
    texts = {name: tokenizer.pieces[token] for name, token in special.items()}
    fast = FastTokenizer(models.WordLevel(ids, unk_token=texts["unk_token"]))
    # Integers lose leading zeros, and zero its sign, before the text is split as `split_words` does it.
    canonical = (Regex(r"(?<![0-9])0+(?=[0-9])"), ""), (Regex(r"-0(?![0-9])"), " 0")
    fast.normalizer = normalizers.Sequence(
        [normalizers.Lowercase(), *(normalizers.Replace(pattern, text) for pattern, text in canonical)]
    )
    words = Regex(r"-?\d+|[^\W\d]+|[^\w\s]")
    fast.pre_tokenizer = pre_tokenizers.Split(words, behavior="removed", invert=True)
    begin = texts["bos_token"]
    fast.post_processor = processors.TemplateProcessing(
        single=f"{begin} $A", special_tokens=[(begin, tokenizer.bos_id)]
    )
    fast.add_special_tokens([AddedToken(text, special=True) for text in texts.values()])
    fast.save(str(folder / "tokenizer.json"))
    options = {"tokenizer_class": "PreTrainedTokenizerFast", "clean_up_tokenization_spaces": False}
    write_json(folder / "tokenizer_config.json", options | texts)
