"""Checkpoints as their authors published them, against PyTorch (tests/golden/original.py wrote both)."""

import io
import json
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.llama import Llama
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.types import ModelInputs, Text
from dsvla_jax.weights.backbones import import_backbones, load_backbones, read_towers
from dsvla_jax.weights.readers.any_format import read_language, read_vision
from dsvla_jax.weights.readers.torch_files import list_tensors
from dsvla_jax.weights.stored_tensors import WeightsError

FOLDER = Path(__file__).parent / "golden" / "original"
CLIP, LLAMA, ADAPTER = FOLDER / "clip.pt", FOLDER / "llama", FOLDER / "adapter.pth"
OUTPUTS = np.load(FOLDER / "outputs.npz")


def assert_close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5 * np.abs(theirs).max())


@pytest.fixture
def copied(tmp_path):
    """The checkpoints, to be damaged."""
    return Path(shutil.copytree(FOLDER, tmp_path / "source"))


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    out = tmp_path_factory.mktemp("original") / "base"
    return out, import_backbones(LLAMA, out, CLIP, adapter=ADAPTER, adapter_heads=3)


def text_inputs(config: ModelConfig) -> ModelInputs:
    tokens = jnp.asarray(OUTPUTS["tokens"], jnp.int32)[None]
    return ModelInputs(
        images=jnp.asarray(OUTPUTS["image"])[:, None],
        point_tokens=jnp.zeros((1, 0, config.vision.width)),
        point_patches=jnp.zeros((1, 0), jnp.int32),
        text=Text(tokens, jnp.ones_like(tokens, bool)),
    )


def test_metas_llama_computes_what_it_should():
    """Meta rotates neighbouring numbers of a head, the model halves."""
    tower = read_language(LLAMA)
    assert tower.unused == ("rope.freqs",)
    assert tower.notes == ("rope.freqs differs from what params.json says, which alone is used, as in Meta's code",)
    model, tokens = Llama(ModelConfig(language=tower.config)), jnp.asarray(OUTPUTS["tokens"])[None]
    positions = jnp.arange(tokens.shape[1])[None]

    @jax.jit
    def run(params):
        bound = model.bind({"params": params})
        hidden, _ = bound(bound.embed(tokens), positions, positions[:, :, None] >= positions[:, None])
        return bound.lm_head(hidden)[0]

    assert_close(run(tower.load()), OUTPUTS["logits"])


def test_llama_adapter_on_openais_clip_computes_what_it_should(imported):
    """Projection, visual blocks, prompts behind gates, adapters, biases and norms: the lineage's whole forward pass."""
    out, _ = imported
    towers = read_towers(out)
    assert towers.vision is not None
    assert towers.projector is not None
    assert towers.language.biases == ("q", "o", "gate", "up", "down")
    config = ModelConfig(
        vision=towers.vision,
        language=towers.language,
        fusion="adapter",
        visual_prompt=towers.projector,
        lora=towers.lora,
    )
    variables, inputs = load_backbones(out), text_inputs(config)
    expected = jax.eval_shape(lambda: initialize(config, jax.random.key(0)))
    assert jax.tree.map(jnp.shape, variables) == jax.tree.map(jnp.shape, expected)
    assert_close(
        jax.jit(VLA(config).apply, static_argnames="method")(variables, inputs), OUTPUTS["adapted_logits"][None]
    )
    features = VLA(config).apply(variables, inputs, method="encode_vision")
    assert_close(np.asarray(features)[0], OUTPUTS["features"])


def test_what_training_saved_beside_the_parameters_is_left_alone(imported):
    _, towers = imported
    assert towers["projector"].unused == ()
    assert set(towers["vision"].unused) == {"logit_scale", "token_embedding.weight"}
    names = list_tensors(ADAPTER)
    assert "optimizer.state.0.exp_avg" in names
    assert names["model.llama.layers.1.attention.gate"].shape == (1, 2, 1, 1)


def test_clip_without_its_projection(imported):
    assert read_vision(CLIP).config.embed_width is None
    assert read_vision(CLIP, 8).load()["positional_embedding"].shape == (17, 64)


class Malicious:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.mkdir, (str(self.target),)


def write_torch_file(file: Path, content: bytes) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", content)
        archive.writestr("archive/byteorder", "little")


def test_nothing_that_a_file_names_is_called(tmp_path):
    content, file = pickle.dumps({"weight": Malicious(tmp_path / "made")}, protocol=2), tmp_path / "evil.pth"
    write_torch_file(file, content)
    with pytest.raises(WeightsError, match=r"evil\.pth: wants to call posix\.mkdir, .* nothing was run"):
        list_tensors(file)
    # Of modules whose objects are ignored, nothing is looked up either.
    write_torch_file(file, content.replace(b"posix\nmkdir", b"pathlib\nos.mkdir"))
    assert list_tensors(file) == {}
    assert not (tmp_path / "made").exists()


def rewrite(file: Path, change) -> None:
    """The archive anew with what ``change`` makes of each entry (None leaves it out)."""
    with zipfile.ZipFile(file) as archive:
        entries = [(info.filename, archive.read(info)) for info in archive.infolist()]
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in entries:
            if (changed := change(name, content)) is not None:
                archive.writestr(name, changed)


def cut(file: Path, keep: int) -> None:
    file.write_bytes(file.read_bytes()[:keep])


def one_less(name, content):
    return content[:-2] if name.endswith("data/3") else content


def without_storage(name, content):
    return None if name.endswith("data/3") else content


def of_doubles(name, content):
    return content.replace(b"HalfStorage", b"DoubleStorage") if name.endswith("data.pkl") else content


def renamed(name, content):
    return content.replace(b"wo.weight", b"wx.weight") if name.endswith("data.pkl") else content


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: cut(f, -30), r"consolidated.00.pth: no zip archive: cut short; download"),
        (lambda f: cut(f, 0), r"consolidated.00.pth: no zip archive: cut short; download"),
        (lambda f: f.write_bytes(pickle.dumps({})), r"consolidated.00.pth: written by a PyTorch before 1.6; save it"),
        (lambda f: f.unlink(), r"llama: expected one file consolidated.00.pth, found none"),
        (lambda f: shutil.copy(f, f.with_name("consolidated.01.pth")), r"several parallel parts"),
        (lambda f: rewrite(f, one_less), r"00.pth: layers\.\S+: F16 \(.*\) does not fill the \d+ bytes"),
        (lambda f: rewrite(f, without_storage), r"00.pth: its data/3 is missing"),
        (lambda f: rewrite(f, of_doubles), r"00.pth: \S+: expected dtype F32, F16, BF16, found DoubleStorage"),
        (lambda f: rewrite(f, renamed), r"missing: layers.\*.attention.wo.weight \(2\); no place .*wx.weight \(2\)"),
        (lambda f: shutil.copy(ADAPTER, f), r"00.pth: wrong architecture: tok_embeddings.weight is missing"),
        (lambda f: f.with_name("params.json").write_text("{"), r"params.json: not JSON"),
        (lambda f: change_params(f, dim=24), r"00.pth: tok_embeddings.weight: expected shape \(21, 24\) .* \(21, 16\)"),
        (lambda f: change_params(f, moe_args={"experts": 8}), r"params.json: .*found moe_args: \{'experts': 8\}"),
        (lambda f: change_params(f, use_scaled_rope="no"), r"use_scaled_rope: expected true or false, found 'no'"),
        (lambda f: change_params(f, vocab_size=22), r"params.json: vocab_size: only 21 is supported, found 22"),
        (lambda f: change_params(f, n_layers=1), r"no place in this architecture for: layers.1."),
    ],
)
def test_damage_to_metas_folder_is_told(copied, damage, message):
    damage(copied / "llama" / "consolidated.00.pth")
    with pytest.raises(WeightsError, match=message):
        import_backbones(copied / "llama", copied / "out")
    assert not (copied / "out").exists()


def change_params(file: Path, **changes) -> None:
    params = file.with_name("params.json")
    params.write_text(json.dumps(json.loads(params.read_text()) | changes))


def test_a_pytorch_file_cut_anywhere_is_an_error(copied):
    file = copied / "adapter.pth"
    content = file.read_bytes()
    for keep in range(0, len(content), 1009):
        file.write_bytes(content[:keep])
        with pytest.raises(WeightsError, match=r"adapter\.pth"):
            list_tensors(file)


class Rebuilt:
    """An array that is pickled as PyTorch pickles a tensor; `write_tensors` puts PyTorch's name in place of mkdir."""

    def __init__(self, key: str, array: np.ndarray):
        self.key, self.array = key, array

    def __reduce__(self):
        strides = tuple(step // self.array.itemsize for step in self.array.strides)
        return os.mkdir, (Storage(self.key, self.array), 0, self.array.shape, strides)


class Storage:
    def __init__(self, key: str, array: np.ndarray):
        kind = {"float32": "FloatStorage", "float16": "HalfStorage", "bfloat16": "BFloat16Storage"}[str(array.dtype)]
        self.persistent_id = ("storage", kind, key, "cpu", array.size)


class TensorPickler(pickle.Pickler):
    def persistent_id(self, obj):
        return getattr(obj, "persistent_id", None) if isinstance(obj, Storage) else None


def write_tensors(file: Path, tensors: dict[str, np.ndarray]) -> Path:
    """A PyTorch file, as far as the reader looks."""
    stream = io.BytesIO()
    TensorPickler(stream, 2).dump({name: Rebuilt(str(i), array) for i, (name, array) in enumerate(tensors.items())})
    write_torch_file(file, stream.getvalue().replace(b"posix\nmkdir", b"torch._utils\n_rebuild_tensor_v2"))
    with zipfile.ZipFile(file, "a") as archive:
        for i, array in enumerate(tensors.values()):
            archive.writestr(f"archive/data/{i}", np.ascontiguousarray(array).tobytes())
    return file


@pytest.mark.parametrize(
    "changed", [None, "llama.layers.1.attention.wq.weight", "llama.output.weight", "clip.visual.conv1.weight"]
)
def test_weights_that_an_adapters_file_repeats_are_compared(tmp_path, changed):
    """A whole model may be in it, in another kind of number; but not another model."""
    llama, clip, adapter = (list_tensors(file) for file in (LLAMA / "consolidated.00.pth", CLIP, ADAPTER))
    tensors = {key.removeprefix("model."): tensor.read() for key, tensor in adapter.items() if key.startswith("model.")}
    repeated = {f"llama.{key}": tensor.read() for key, tensor in llama.items() if len(tensor.shape) > 1}
    repeated |= {f"clip.{key}": tensor.read() for key, tensor in clip.items() if key.startswith("visual.")}
    if changed is not None:
        repeated[changed] = repeated[changed].copy()
        repeated[changed].flat[-1] += 0.5
    repeated = {key: values.astype(np.float32 if "clip" in key else jnp.bfloat16) for key, values in repeated.items()}
    file = write_tensors(tmp_path / "whole.pth", tensors | repeated)
    if changed is None:
        towers = import_backbones(LLAMA, tmp_path / "out", CLIP, adapter=file, adapter_heads=3)
        np.testing.assert_array_equal(towers["language"].load()["output"], read_language(LLAMA).load()["output"])
        return
    with pytest.raises(WeightsError, match=f"whole.pth: {changed}: not the "):
        import_backbones(LLAMA, tmp_path / "out", CLIP, adapter=file, adapter_heads=3)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"adapter_heads": 5}, r"visual_prompt.width: expected a multiple of 2 \* heads = 10, got 12"),
        ({"image_size": 8}, r"adapter_query.weight: 10 rows are not those of up to 2 layers with 17 each, .* 8 pixels"),
        ({"adapter": LLAMA / "consolidated.00.pth"}, r"wrong architecture: .*adapter_query.weight, none does"),
        ({"vision_source": ADAPTER}, r"adapter.pth: wrong architecture: .*visual.class_embedding, none does"),
    ],
)
def test_sources_that_do_not_fit_each_other(tmp_path, options, message):
    arguments = {"vision_source": CLIP, "adapter": ADAPTER, "adapter_heads": 3} | options
    with pytest.raises(WeightsError, match=message):
        import_backbones(LLAMA, tmp_path / "out", **arguments)
    assert not (tmp_path / "out").exists()
