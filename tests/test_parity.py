"""Live against `transformers` and `peft`, where they are installed: make parity. Weights are random, all in float32.

tests/test_backbones.py compares with what transformers computed once; here it runs, on what was exported, too.
"""

# Where the packages are missing, every test is skipped.
# pyright: reportPossiblyUnboundVariable=false

import dataclasses
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from dsvla_jax.model.clip import VisionTower
from dsvla_jax.model.config import LanguageConfig, LoraConfig, ModelConfig, RopeScaling, VisionConfig
from dsvla_jax.model.llama import Llama
from dsvla_jax.model.lora import merge_lora
from dsvla_jax.weights.export import ExportOptions, export_run
from dsvla_jax.weights.readers.any_format import read_language, read_vision
from tests.golden.backbones import CLIPS, LLAMAS, draw, draw_image, padded_batch
from tests.run_folders import TOKENIZER, write_run

MISSING = [name for name in ("torch", "transformers", "peft") if find_spec(name) is None]
pytestmark = [
    pytest.mark.parity,
    pytest.mark.skipif(bool(MISSING), reason=f"needs {', '.join(MISSING)}: make parity"),
]
if not MISSING:
    import peft  # pyright: ignore[reportMissingImports]
    import torch  # pyright: ignore[reportMissingImports]
    import transformers  # pyright: ignore[reportMissingImports]

# More shapes than the stored ones: many heads over few, an odd width of everything, three layers, one head.
LANGUAGES = LLAMAS | {
    "eight_over_two": {
        "hidden_size": 64,
        "num_attention_heads": 8,
        "num_key_value_heads": 2,
        "intermediate_size": 97,
        "vocab_size": 131,
        "rope_parameters": {"rope_type": "default", "rope_theta": 500000.0},
    },
    "one_head": {"hidden_size": 26, "num_attention_heads": 1, "intermediate_size": 7, "vocab_size": 11},
}
VISIONS = CLIPS | {
    "many_patches": {
        "hidden_size": 36,
        "num_attention_heads": 6,
        "intermediate_size": 50,
        "image_size": 33,
        "patch_size": 3,
    }
}


def assert_close(ours: Any, theirs: Any, tolerance: float = 1e-4) -> None:
    """Within ``tolerance`` of the oracle's largest value."""
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * np.abs(theirs).max())


def fill(model: Any) -> Any:
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.copy_(torch.from_numpy(draw(name, tuple(parameter.shape))))
    return model.eval()


def their_language(model: Any, batch: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Last hidden states and logits."""
    with torch.no_grad():
        output = model(
            input_ids=torch.from_numpy(batch["tokens"]),
            attention_mask=torch.from_numpy(batch["mask"]).long(),
            position_ids=torch.from_numpy(batch["positions"]),
            output_hidden_states=True,
        )
    return output.hidden_states[-1].float().numpy(), output.logits.float().numpy()


def their_vision(model: Any, image: np.ndarray) -> np.ndarray:
    """All tokens behind the last norm (transformers applies it to the class token alone)."""
    with torch.no_grad():
        tower = getattr(model, "vision_model", model)
        last = tower(torch.from_numpy(image).permute(0, 3, 1, 2)).last_hidden_state
        return tower.post_layernorm(last).float().numpy()


def our_language(model: ModelConfig, variables: Any, batch: dict[str, np.ndarray]) -> tuple[Any, Any]:
    length = batch["tokens"].shape[1]
    mask = jnp.tril(jnp.ones((length, length), bool)) & batch["mask"][:, None, :]

    @jax.jit
    def run(variables):
        bound = Llama(model).bind(variables)
        hidden, _ = bound(bound.embed(jnp.asarray(batch["tokens"])), jnp.asarray(batch["positions"]), mask)
        return hidden, bound.lm_head(hidden)

    return run(variables)


def our_vision(model: ModelConfig, variables: Any, image: np.ndarray) -> Any:
    no_points = jnp.zeros((len(image), 0, model.vision.width)), jnp.zeros((len(image), 0), jnp.int32)
    return jax.jit(VisionTower(model).apply)(variables, image[:, None], *no_points)


@pytest.mark.parametrize("name", LANGUAGES)
def test_hidden_states_and_logits_of_llama(tmp_path, name):
    config = transformers.LlamaConfig(**LANGUAGES[name], num_hidden_layers=3)
    theirs = fill(transformers.LlamaForCausalLM(config))
    theirs.save_pretrained(tmp_path / "source")
    tower = read_language(tmp_path / "source")
    assert isinstance(tower.config, LanguageConfig)
    batch = padded_batch(config.vocab_size, 60 if name == "llama3" else 13)
    expected = their_language(theirs, batch)
    actual = our_language(ModelConfig(language=tower.config), {"params": tower.load()}, batch)
    for ours, oracle in zip(actual, expected, strict=True):
        assert_close(np.asarray(ours)[batch["mask"]], oracle[batch["mask"]])


@pytest.mark.parametrize("stored", ["table", "head", "equal", "different"])
def test_logits_of_tied_llamas_however_they_are_stored(tmp_path, stored):
    """Tied by config.json: with the table, the head, both alike, or a head of its own, which transformers 5 uses."""
    config = transformers.LlamaConfig(**LANGUAGES["grouped_tied"], num_hidden_layers=2)
    fill(transformers.LlamaForCausalLM(config)).save_pretrained(tmp_path)
    file, head = tmp_path / "model.safetensors", "lm_head.weight"
    tensors = load_file(file)
    table = tensors["model.embed_tokens.weight"]
    if stored == "head":
        del tensors["model.embed_tokens.weight"]
    if stored != "table":
        tensors[head] = table[::-1].copy() if stored == "different" else table
    save_file(tensors, file, metadata={"format": "pt"})
    tower, batch = read_language(tmp_path), padded_batch(config.vocab_size, 13)
    assert isinstance(tower.config, LanguageConfig)
    assert tower.config.tie_embeddings == (stored != "different")
    _, expected = their_language(transformers.LlamaForCausalLM.from_pretrained(tmp_path).eval(), batch)
    _, actual = our_language(ModelConfig(language=tower.config), {"params": tower.load()}, batch)
    assert_close(np.asarray(actual)[batch["mask"]], expected[batch["mask"]], 1e-5)


@pytest.mark.parametrize("name", VISIONS)
def test_hidden_states_of_clip(tmp_path, name):
    theirs = fill(transformers.CLIPVisionModel(transformers.CLIPVisionConfig(**VISIONS[name], num_hidden_layers=3)))
    theirs.save_pretrained(tmp_path / "source")
    tower = read_vision(tmp_path / "source")
    assert isinstance(tower.config, VisionConfig)
    image = draw_image(tower.config.image_size)
    ours = our_vision(ModelConfig(vision=tower.config), {"params": tower.load()}, image)
    assert_close(ours, their_vision(theirs, image))


CONFIGS = {
    "plain": ModelConfig(
        vision=VisionConfig(image_size=24, patch_size=8, width=24, layers=2, heads=3, mlp_ratio=1.5),
        language=LanguageConfig(vocab_size=TOKENIZER.vocab_size, width=48, layers=2, heads=4, kv_heads=4, ffn=64),
        lora=LoraConfig(rank=3, alpha=7.0),
    ),
    "grouped_tied_scaled_projected": ModelConfig(
        vision=VisionConfig(image_size=21, patch_size=7, width=40, layers=3, heads=5, embed_width=16),
        language=LanguageConfig(
            vocab_size=TOKENIZER.vocab_size,
            width=54,
            layers=3,
            heads=6,
            kv_heads=2,
            ffn=77,
            tie_embeddings=True,
            explicit_head_dim=12,
            rope_scaling=RopeScaling(8.0, 1.0, 4.0, 16),
        ),
        lora=LoraConfig(rank=5, alpha=2.0, targets=("q", "v", "up", "down")),
    ),
}
BATCH = padded_batch(TOKENIZER.vocab_size, 24)


@dataclasses.dataclass(frozen=True)
class Case:
    """A run with trained-looking adapters, what our model computes with it, and its exports."""

    model: ModelConfig
    variables: Any
    root: Path
    logits: np.ndarray
    vision: np.ndarray

    def tower(self, name: str) -> dict[str, Any]:
        return {collection: tree[name] for collection, tree in self.variables.items()}

    def without_projection(self) -> ModelConfig:
        return dataclasses.replace(self.model, vision=dataclasses.replace(self.model.vision, embed_width=None))


def image_of(case: Case) -> np.ndarray:
    return draw_image(case.model.vision.image_size)


@pytest.fixture(scope="module", params=CONFIGS)
def case(request, tmp_path_factory) -> Case:
    model, root = CONFIGS[request.param], tmp_path_factory.mktemp("case")
    variables = write_run(root / "run", model)
    # The base alone, for peft to adapt, is the merged export of a run without adapters.
    bare = dataclasses.replace(model, lora=None)
    write_run(root / "bare", bare, "full")
    export_run(root / "bare", root / "base", bare, TOKENIZER, ExportOptions(merged=True))
    bases = {name: str(root / "base" / name) for name in ("language", "vision")}
    export_run(root / "run", root / "adapters", model, TOKENIZER, ExportOptions(bases=bases))
    for name, dtype in (("merged", np.float32), ("half", jnp.bfloat16)):
        export_run(
            root / "run", root / name, model, TOKENIZER, ExportOptions(merged=True, dtype=dtype, shard_bytes=3e4)
        )
    case = Case(model, variables, root, np.zeros(0), np.zeros(0))
    logits = np.asarray(our_language(model, case.tower("language"), BATCH)[1])[BATCH["mask"]]
    vision = np.asarray(
        our_vision(case.without_projection(), case.tower("vision"), draw_image(model.vision.image_size))
    )
    return dataclasses.replace(case, logits=logits, vision=vision)


@pytest.fixture
def no_warnings(recwarn):
    """peft tells of keys that it misses in a warning only."""
    yield
    messages = [str(warning.message) for warning in recwarn if "adapter" in str(warning.message).lower()]
    assert not messages


def test_exported_adapters_in_peft_give_our_outputs(case, no_warnings):
    language = peft.AutoPeftModelForCausalLM.from_pretrained(str(case.root / "adapters" / "language")).eval()
    assert language.peft_config["default"].r == case.model.lora.rank
    module = language.base_model.model.model.layers[1].self_attn.q_proj
    assert module.scaling["default"] == pytest.approx(case.model.lora.alpha / case.model.lora.rank)
    assert_close(case.logits, their_language(language, BATCH)[1][BATCH["mask"]])
    vision = peft.AutoPeftModel.from_pretrained(str(case.root / "adapters" / "vision")).eval()
    assert_close(case.vision, their_vision(vision.base_model.model, image_of(case)))


def test_merged_in_peft_and_by_us_is_the_same(case):
    merged = merge_lora(case.variables, case.model.lora)["params"]
    for tower, auto in (("language", peft.AutoPeftModelForCausalLM), ("vision", peft.AutoPeftModel)):
        folder = case.root / f"merged_by_peft_{tower}"
        model = auto.from_pretrained(str(case.root / "adapters" / tower)).merge_and_unload()
        model.save_pretrained(folder)
        projected = tower == "vision" and "projection" in merged[tower]
        read = read_language(folder) if tower == "language" else read_vision(folder, projection=projected)
        jax.tree.map(lambda ours, theirs: assert_close(ours, theirs, 1e-5), merged[tower], read.load())


def open_merged(case: Case, folder: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """What our model computes with its adapters, beside what transformers does with a merged folder, by tower."""
    options = {"dtype": torch.float32, "output_loading_info": True}
    projected = case.model.vision.embed_width is not None
    kind = transformers.CLIPVisionModelWithProjection if projected else transformers.CLIPVisionModel
    vision, seen_vision = kind.from_pretrained(case.root / folder / "vision", **options)
    language, seen = transformers.LlamaForCausalLM.from_pretrained(case.root / folder / "language", **options)
    assert not any(seen.values()), seen
    assert not any(seen_vision.values()), seen_vision
    logits = their_language(language.eval(), BATCH)[1][BATCH["mask"]]
    return [(case.logits, logits), (case.vision, their_vision(vision.eval(), image_of(case)))]


def test_merged_folder_in_transformers_gives_the_adapted_outputs(case):
    for ours, theirs in open_merged(case, "merged"):
        assert_close(ours, theirs, 1e-5)


def test_merged_in_bfloat16_is_what_peft_merges_rounded(case):
    """Both computed in float32, so that only the rounding of the merged weights counts."""
    (adapted, rounded), _ = open_merged(case, "half")
    model = peft.AutoPeftModelForCausalLM.from_pretrained(str(case.root / "adapters" / "language"))
    model = model.merge_and_unload().eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(parameter.bfloat16())
    assert_close(rounded, their_language(model, BATCH)[1][BATCH["mask"]], 1e-3)
    moved = np.abs(rounded - adapted).max() / np.abs(adapted).max()
    print(f"bfloat16 on disk moves the logits by {moved:.1e} of the largest")


def test_the_exported_vocabulary_in_transformers(case):
    tokenizer = transformers.AutoTokenizer.from_pretrained(case.root / "merged" / "language")
    text = "stack 2 red blocks: -100 0 200"
    assert tokenizer(text).input_ids == [TOKENIZER.bos_id, *TOKENIZER.encode(text)]
    assert tokenizer.eos_token_id == TOKENIZER.eos_id
    assert tokenizer.decode(tokenizer(text).input_ids, skip_special_tokens=True) == "stack 2 red blocks : -100 0 200"


def test_through_transformers_and_back_nothing_changes(tmp_path, case):
    """Ours -> transformers -> its save_pretrained -> ours."""
    language = transformers.LlamaForCausalLM.from_pretrained(case.root / "merged" / "language")
    language.save_pretrained(tmp_path / "again")
    before, after = read_language(case.root / "merged" / "language"), read_language(tmp_path / "again")
    assert after.config == before.config
    jax.tree.map(np.testing.assert_array_equal, after.load(), before.load())
