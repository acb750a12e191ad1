"""What training starts from: imported weights in a model, the dtypes of a frozen base, and what stays in float32."""

import dataclasses
from pathlib import Path
from typing import Any, get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.checkpoints.storage import CheckpointError
from dsvla_jax.data_config import DataConfig
from dsvla_jax.encoding.encode import model_inputs
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment, MeshConfig
from dsvla_jax.model.config import LoraConfig, ModelConfig
from dsvla_jax.model.layers import REMAT_POLICIES
from dsvla_jax.model.llama import rotary_tables
from dsvla_jax.model.lora import merge_lora
from dsvla_jax.model.partition import make_sharded
from dsvla_jax.model.quantize import dequantize, quantize, quantize_kernel
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.policies.config import BehaviourCloningConfig
from dsvla_jax.policy import load_policy_config, save_policy_config
from dsvla_jax.suite_vocabulary import suite_tokenizer
from dsvla_jax.training.sharding import make_mesh
from dsvla_jax.training.state import make_optimizer
from dsvla_jax.weights.backbones import import_backbones, load_backbones, read_towers, require_base
from dsvla_jax.weights.base_variables import base_variables
from tests.learning import start_of, step_of
from tests.run_folders import MODEL, TOKENIZER, write_run
from tests.small import small_encoding
from tests.test_training import NO_NUMBERS, VOCABULARY, random_batch, small_experiment

GOLDEN = Path(__file__).parent / "golden"
VALUES = np.full(VOCABULARY, np.nan, np.float32)
MESH = MeshConfig(data=1)


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    out = tmp_path_factory.mktemp("imported") / "base"
    import_backbones(GOLDEN / "llama_sharded", out)
    return out


def experiment_on(imported: Path, **changes: Any) -> Experiment:
    """Adapters on the imported decoder, and on a random vision tower."""
    small = small_experiment(regime="lora", base=str(imported), mesh=MESH)
    model = dataclasses.replace(small.model, language=read_towers(imported).language, **changes)
    return dataclasses.replace(small, model=model)


def start(experiment: Experiment):
    mesh = make_mesh(experiment.mesh, jax.devices()[:1])
    values = np.full(experiment.model.language.vocab_size, np.nan, np.float32)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)

    def make(base):
        return start_of(experiment, values, optimizer, base)

    return make_sharded(make, mesh, base_of(experiment, mesh))


def base_of(experiment, mesh):
    """The variables of its base, with the words of the task suite or of the experiment's tokenizer."""
    tokenizer = load_tokenizer(experiment.tokenizer) if experiment.tokenizer else suite_tokenizer()
    return base_variables(experiment.base, experiment.model, tokenizer, experiment.regime != "full", mesh)


@pytest.mark.parametrize("base_dtype", ["same", "bfloat16"])
def test_training_starts_from_imported_weights(imported, base_dtype):
    experiment = experiment_on(imported, base_dtype=base_dtype)
    state, frozen = start(experiment)
    language = load_backbones(imported)["params"]["language"]
    dtype = jnp.dtype("bfloat16" if base_dtype == "bfloat16" else "float32")

    def check(path, mine, theirs):
        matrix = path[-1].key in ("kernel", "embedding", "output")
        assert mine.dtype == (dtype if matrix else jnp.float32)
        np.testing.assert_array_equal(mine, theirs.astype(mine.dtype))

    jax.tree_util.tree_map_with_path(check, frozen["params"]["language"], language)
    random = initialize(experiment.model, jax.random.key(experiment.seed))
    same = jax.tree.map(lambda a, b: np.array_equal(a, b), state.trainable["lora"], random["lora"])
    assert all(jax.tree.leaves(same)), "what the folder does not hold is random by the seed"


def test_a_base_of_other_sizes_names_the_fields(imported):
    experiment = experiment_on(imported)
    language = dataclasses.replace(experiment.model.language, width=32, rope_theta=5.0)
    other = dataclasses.replace(experiment, model=dataclasses.replace(experiment.model, language=language))
    with pytest.raises(
        CheckpointError, match=r"language.width: the config says 32, the folder 16; .*rope_theta: .* 5.0"
    ):
        start(other)


def test_a_base_run_of_another_vocabulary_is_refused(tmp_path):
    """Whose embedding has as many rows, but for other words."""
    small = small_experiment(regime="full", base=str(tmp_path / "run"), mesh=MESH)
    language = dataclasses.replace(small.model.language, vocab_size=suite_tokenizer().vocab_size)
    model = dataclasses.replace(small.model, language=language, lora=None)
    experiment, mesh = dataclasses.replace(small, model=model), make_mesh(MESH, jax.devices()[:1])
    written = write_run(tmp_path / "run", model, "full")
    with pytest.raises(UserError, match=r"base: .* was trained with another vocabulary, .*--tokenizer"):
        base_of(experiment, mesh)
    params = base_of(dataclasses.replace(experiment, tokenizer=str(tmp_path / "run")), mesh)["params"]
    np.testing.assert_array_equal(params["language"]["embedding"], written["params"]["language"]["embedding"])


def test_adapters_of_the_base_need_adapters_in_the_config(tmp_path):
    source = GOLDEN / "original"
    adapter, out = source / "adapter.pth", tmp_path / "base"
    import_backbones(source / "llama", out, source / "clip.pt", adapter=adapter, adapter_heads=3)
    towers = read_towers(out)
    assert towers.vision is not None
    assert towers.projector is not None
    sizes = ModelConfig(towers.vision, towers.language, fusion="adapter", visual_prompt=towers.projector)
    model = dataclasses.replace(sizes, lora=LoraConfig())
    small, vision = small_experiment(regime="lora", base=str(out), mesh=MESH), towers.vision
    encoding = dataclasses.replace(
        small.encoding,
        image_size=vision.image_size,
        patch_size=vision.patch_size,
        points=dataclasses.replace(small.encoding.points, width=vision.width),
    )
    with pytest.raises(CheckpointError, match=r"model.lora.rank: the config says 16, the folder 2"):
        start(dataclasses.replace(small, encoding=encoding, model=model))
    model = dataclasses.replace(model, lora=LoraConfig(rank=2, alpha=2.0))
    state, _ = start(dataclasses.replace(small, encoding=encoding, model=model))
    gate = load_backbones(out)["params"]["projector"]["gate"]
    assert np.abs(gate).min() > 0
    np.testing.assert_array_equal(state.trainable["params"]["projector"]["gate"], gate)


def test_eight_bits_are_within_half_a_step_and_zero_stays_zero():
    kernel = np.random.default_rng(0).normal(size=(3, 50, 20)).astype(np.float32) * np.geomspace(1e-6, 1e3, 20)
    kernel[1, :, 4] = 0
    values, scale = quantize_kernel(jnp.asarray(kernel, jnp.float32))
    assert values.dtype == jnp.int8
    restored = np.asarray(values, np.float64) * np.asarray(scale)[:, None]
    assert (np.abs(restored - kernel) <= 0.501 * np.asarray(scale)[:, None]).all()
    assert not restored[1, :, 4].any()
    np.testing.assert_allclose(np.abs(restored).max(1), np.abs(kernel).max(1), rtol=1e-6)


def test_a_model_with_eight_bit_kernels_is_the_model_with_their_values():
    """Same logits, gradients of adapters, and merged weights; the frozen towers take little more than a quarter."""
    model = dataclasses.replace(small_experiment().model, base_dtype="int8")
    experiment = dataclasses.replace(small_experiment(regime="lora"), model=model)
    variables = initialize(model, jax.random.key(0))
    full = {**variables, "params": dequantize(variables["params"])}
    batch = random_batch(experiment)
    example = jax.tree.map(jnp.asarray, batch)
    inputs = model_inputs(example.pictures, example.text, experiment.encoding)

    @jax.jit
    def run(params, lora):
        def loss(lora):
            logits: Any = VLA(model).apply({"params": params, "lora": lora}, inputs)
            return jnp.square(logits).mean(), logits

        (_, logits), gradients = jax.value_and_grad(loss, has_aux=True)(lora)
        return logits, gradients

    expected, actual = run(full["params"], variables["lora"]), run(variables["params"], variables["lora"])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), actual, expected)
    adapters = jax.tree.map(lambda leaf: leaf + 0.01, variables["lora"])
    assert model.lora is not None
    merged, wanted = (merge_lora({**tree, "lora": adapters}, model.lora) for tree in (variables, full))
    jax.tree.map(np.testing.assert_array_equal, merged, wanted)

    def kernel_bytes(tree):
        layers = [tree["params"][tower]["layers"] for tower in ("vision", "language")]
        return sum(
            leaf.nbytes
            for path, leaf in jax.tree_util.tree_leaves_with_path(layers)
            if "kernel" in jax.tree_util.keystr(path[-1:])
        )

    # Four bytes a scale beside 32 to 128 rows of one byte.
    assert kernel_bytes(variables) < 0.30 * kernel_bytes(full)


def test_eight_bit_base_trains_from_imported_weights(imported):
    experiment = experiment_on(imported, base_dtype="int8")
    _, frozen = start(experiment)
    expected = quantize(load_backbones(imported)["params"] | {"vision": {}})["language"]
    jax.tree.map(np.testing.assert_array_equal, frozen["params"]["language"], expected)
    with pytest.raises(
        UserError, match=r"base_dtype: expected 'same' with regime 'full', .* got 'int8'; use regime 'lora'"
    ):
        dataclasses.replace(experiment, regime="full")


PRECISE = {"exp", "log", "sin", "cos", "rsqrt", "logsumexp", "reduce_max", "div"}


def equations(jaxpr):
    """Every equation of a program, those of its loops and branches too."""
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from equations(inner)


@pytest.mark.parametrize("fusion", ["prefix", "adapter"])
def test_bfloat16_where_it_is_safe_and_float32_where_it_matters(fusion):
    """Products take bfloat16; norms, softmax, rotations and the loss are float32 through forward and backward pass."""
    small = small_experiment(regime="lora")
    model = dataclasses.replace(small.model, dtype="bfloat16", fusion=fusion)
    experiment = dataclasses.replace(small, model=model)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    state, frozen = jax.eval_shape(lambda: start_of(experiment, VALUES, optimizer))
    step = step_of(experiment, optimizer, NO_NUMBERS)
    batch = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, random_batch(experiment)))
    program = list(equations(jax.make_jaxpr(step)(state, frozen, batch).jaxpr))

    def dtypes(equation):
        return {
            variable.aval.dtype for variable in equation.invars if jnp.issubdtype(variable.aval.dtype, jnp.floating)
        }

    found = {equation.primitive.name for equation in program}
    assert found >= {"exp", "log", "rsqrt", "dot_general"}
    tables = rotary_tables(jnp.arange(3)[None], model.language, 3)
    assert {table.dtype for table in tables} == {jnp.dtype(jnp.float32)}
    for equation in program:
        if equation.primitive.name in PRECISE:
            assert jnp.bfloat16 not in dtypes(equation), equation
    products = [equation for equation in program if equation.primitive.name == "dot_general"]
    narrow = [equation for equation in products if dtypes(equation) == {jnp.dtype(jnp.bfloat16)}]
    assert len(narrow) > 0.6 * len(products)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(state.trainable))


def test_remat_policies_are_those_of_jax():
    names = set(get_args(get_type_hints(ModelConfig)["remat"])) - {"none"}
    assert len(names) > 2
    for name in names:
        assert callable(getattr(jax.checkpoint_policies, str(REMAT_POLICIES.get(name, name))))


def test_a_base_of_one_camera_serves_a_model_of_two(tmp_path: Path):
    """The embeddings of cameras start at zero and learn, whatever else is frozen; all else is the base's."""
    write_run(tmp_path / "base", MODEL, "full")
    model = dataclasses.replace(MODEL, cameras=2)
    require_base(tmp_path / "base", model)
    base = base_variables(str(tmp_path / "base"), model, TOKENIZER, True, make_mesh(MESH, jax.devices()[:1]))
    experiment = dataclasses.replace(
        small_experiment(regime="lora"),
        encoding=small_encoding(),
        model=model,
        data=DataConfig(cameras=("front", "wrist")),
    )
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    state, frozen = start_of(experiment, None, optimizer, base)
    embedding = state.trainable["params"]["vision"].pop("camera_embedding")
    assert not embedding.any()
    assert embedding.shape == (2, MODEL.vision.width)
    assert not state.trainable["params"]["vision"]
    np.testing.assert_array_equal(
        frozen["params"]["vision"]["positional_embedding"], base["params"]["vision"]["positional_embedding"]
    )
    baseline = dataclasses.replace(load_policy_config(tmp_path / "base"), baseline=BehaviourCloningConfig())
    save_policy_config(tmp_path / "base", baseline, TOKENIZER)
    with pytest.raises(CheckpointError, match="base: a policy of behaviour_cloning; expected a run of 3DS-VLA"):
        require_base(tmp_path / "base", model)
    write_run(tmp_path / "two", model, "full")
    with pytest.raises(CheckpointError, match="vision/camera_embedding"):
        require_base(tmp_path / "two", MODEL)
