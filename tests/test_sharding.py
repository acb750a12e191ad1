"""Training on meshes: the same losses on any of them, memory that shrinks with them, and errors that name the fix."""

import dataclasses
import json
import math
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from socket import socket
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import traverse_util
from jax.sharding import AbstractMesh

from configs import get_config
from dsvla_jax.encoding.encode import model_inputs
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import MeshConfig
from dsvla_jax.model.partition import MESH_AXES, shardings
from dsvla_jax.model.variables import join_variables, narrow_frozen, split_variables
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.training.sharding import batch_part, make_mesh, part_of_process
from dsvla_jax.training.state import make_optimizer
from tests.learning import start_of
from tests.sharded_training import batches, tiny_experiment

ROOT = Path(__file__).parent.parent


def start(devices: int, *arguments: str) -> subprocess.Popen[str]:
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "JAX_PLATFORMS": "cpu",
        # Programs this small take longer to compile than to run: let the compiler do little, and do it once.
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level=0",
        "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".cache" / "xla"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    command = [sys.executable, "-m", "tests.sharded_training", *arguments]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def told(process: subprocess.Popen[str]) -> dict[str, list[str]]:
    """What the process printed, by the first word of each line."""
    output, errors = process.communicate(timeout=900)
    assert process.returncode == 0, errors
    lines: dict[str, list[str]] = {}
    for line in output.splitlines():
        word, _, rest = line.partition(" ")
        lines.setdefault(word, []).append(rest)
    return lines


def losses(process: subprocess.Popen[str]) -> list[list[float]]:
    return [json.loads(line) for line in told(process)["losses"]]


def curves_on(runs: dict[str, tuple[str, int, int]], *more: str) -> dict[str, list[float]]:
    """Losses by name of run; a run has sizes of the mesh, its devices (0: all 8) and parts of the batch."""
    meshes, devices, parts = zip(*runs.values(), strict=True)
    options = ["--meshes", *meshes, "--devices", *map(str, devices), "--accumulation", *map(str, parts)]
    return dict(zip(runs, losses(start(8, *options, *more)), strict=True))


def free_address() -> str:
    """An address that nobody listens on."""
    with socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def two_processes(*more: str, mesh: str = "2,2,2", devices: int = 4) -> list[subprocess.Popen[str]]:
    """Two processes of so many devices each."""
    options = ["--meshes", mesh, "--devices", "0", "--accumulation", "1", "--coordinator", free_address(), *more]
    return [start(devices, *options, "--process", str(index), "--processes", "2") for index in range(2)]


def curves_of_processes(*more: str) -> list[list[float]]:
    """The losses that two processes of 4 devices each report."""
    return [losses(process)[0] for process in two_processes(*more)]


def require_learning_alike(curve: list[float], expected: list[float]) -> None:
    assert len(expected) == 20
    assert np.mean(expected[-3:]) < np.mean(expected[:3]), "it learns"
    np.testing.assert_allclose(curve, expected, rtol=1e-5)


@pytest.fixture(scope="module")
def one_device() -> dict[str, list[float]]:
    return curves_on({"one": ("1,1,1", 1, 1), "2 x 2 x 2 in two parts": ("2,2,2", 0, 2)})


def test_losses_are_the_same_on_one_device_and_on_eight(one_device):
    require_learning_alike(one_device["2 x 2 x 2 in two parts"], one_device["one"])


def test_losses_are_the_same_in_two_processes(one_device):
    for curve in curves_of_processes():
        require_learning_alike(curve, one_device["one"])


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["prefix", "adapter"])
def test_losses_are_the_same_on_any_mesh(fusion):
    runs = {
        "one": ("1,1,1", 1, 1),
        "data": ("8,1,1", 0, 1),
        "fsdp": ("1,8,1", 0, 1),
        "2 x 2 x 2": ("2,2,2", 0, 1),
        "in four parts": ("1,4,1", 4, 4),
    }
    options = ("--fusion", fusion, "--points")
    curves = curves_on(runs, *options)
    for curve in (*curves.values(), *curves_of_processes(*options)):
        require_learning_alike(curve, curves["one"])


@pytest.mark.slow
def test_losses_with_muon_are_the_same_on_any_mesh():
    runs = {"one": ("1,1,1", 1, 1), "fsdp": ("1,8,1", 0, 1), "2 x 2 x 2": ("2,2,2", 0, 1)}
    curves = curves_on(runs, "--method", "muon")
    for curve in curves.values():
        require_learning_alike(curve, curves["one"])


@pytest.mark.slow
def test_a_checkpoint_of_eight_devices_goes_on_anywhere(one_device, tmp_path: Path):
    run = ("--run", str(tmp_path))
    whole = told(start(8, "--meshes", "2,2,2", "--devices", "0", "--accumulation", "1", *run, "--until", "10"))
    first = json.loads(whole["losses"][0])
    others = ("1,1,1", "1,2,1", "2,1,2")
    options = ("--meshes", *others, "--devices", "1", "2", "4", "--accumulation", "1", "1", "1", *run)
    reports = [told(start(8, *options)), *map(told, two_processes(*run, mesh="2,2,1", devices=2))]
    assert [len(report["restored"]) for report in reports] == [3, 1, 1]
    for report in reports:
        assert set(report["restored"]) == set(whole["saved"]), "every value of state and base is the same"
        for line in report["losses"]:
            require_learning_alike([*first, *json.loads(line)], one_device["one"])


@pytest.mark.slow
def test_validation_says_the_same_on_any_mesh():
    options = ("--until", "2", "--validate")
    meshes = ("--meshes", "1,1,1", "2,2,2", "--devices", "1", "0", "--accumulation", "1", "1")
    reports = [told(start(8, *meshes, *options)), *map(told, two_processes(*options))]
    figures = [json.loads(line) for report in reports for line in report["validation"]]
    assert len(figures) == 4
    assert figures[0]["validation/loss"] > 0
    for other in figures[1:]:
        assert other == pytest.approx(figures[0], rel=1e-5)


def bytes_on_each(tree: Any, mesh: Any) -> int:
    def size(leaf: Any, where: Any) -> int:
        return math.prod(where.shard_shape(leaf.shape)) * leaf.dtype.itemsize

    return sum(jax.tree.leaves(jax.tree.map(size, tree, shardings(tree, mesh))))


@pytest.fixture(scope="module")
def paper() -> tuple[Any, Any]:
    experiment = get_config("paper_7b")
    values = np.full(experiment.model.language.vocab_size, np.nan, np.float32)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    return jax.eval_shape(partial(start_of, experiment, values, optimizer))


def whole(tree: Any) -> int:
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("shape", [(1, 16, 1), (1, 256, 1), (4, 16, 4)])
def test_state_and_base_are_split_and_hardly_anything_is_copied(paper, shape):
    state, frozen = paper
    mesh = AbstractMesh(shape, MESH_AXES)
    ways, copied = shape[1] * shape[2], 8 * 2**20
    assert bytes_on_each(frozen, mesh) < whole(frozen) / ways + copied
    assert bytes_on_each(state, mesh) < whole(state) / shape[1] + copied
    assert bytes_on_each(frozen, AbstractMesh((16, 1, 1), MESH_AXES)) == whole(frozen)


def test_optimizer_memory_is_that_of_what_learns(paper):
    state, _ = paper
    moments = 2 * whole(state.trainable)
    assert moments <= whole(state.optimizer) < moments + 100


def test_a_checkpoint_of_adapters_alone_is_small(paper):
    state, _ = paper
    adapters = state.trainable["lora"]
    assert whole(adapters) == 4 * (39_976_960 + 7_077_888) == 188_219_392
    experiment = dataclasses.replace(get_config("paper_7b"), regime="adapters")
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    alone, frozen = jax.eval_shape(partial(start_of, experiment, None, optimizer))
    assert set(alone.trainable) == {"lora"}
    assert whole(alone.trainable) == whole(adapters) < 250e6
    # With the projection, which the paper's regime trains too, it is five times that.
    assert 1.3e9 < whole(state.trainable) == 4 * 334_283_776
    assert whole(alone.optimizer) < 2 * whole(adapters) + 100
    assert "projector" in frozen["params"]


def test_the_frozen_base_is_kept_in_the_dtype_that_it_is_used_in(paper):
    _, frozen = paper
    flat: Any = traverse_util.flatten_dict(frozen)
    wide = {path[-1] for path, leaf in flat.items() if leaf.dtype != "bfloat16"}
    assert wide == {"scale", "bias", "class_embedding", "positional_embedding"}


def test_narrowing_the_frozen_base_changes_nothing():
    experiment = tiny_experiment("adapter", points=False)
    experiment = dataclasses.replace(experiment, model=dataclasses.replace(experiment.model, dtype="bfloat16"))
    trainable, frozen = split_variables(initialize(experiment.model, jax.random.key(0)), "lora")
    batch = jax.tree.map(jnp.asarray, batches(experiment)[0])

    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def logits(frozen):
        inputs = model_inputs(batch.pictures, batch.text, experiment.encoding)
        return VLA(experiment.model).apply(join_variables(trainable, frozen), inputs)

    np.testing.assert_array_equal(logits(narrow_frozen(frozen, jnp.dtype("bfloat16"))), logits(frozen))


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        ((-1, 1, 1), (8, 1, 1)),
        ((2, -1, 2), (2, 2, 2)),
        ((1, 8, 1), (1, 8, 1)),
        ((3, -1, 1), "data=3, fsdp=-1, tensor=1 cannot be laid over 8 devices"),
        ((2, 2, 1), "product of 8"),
        ((-1, -1, 1), "-1 .* for one axis at most"),
        ((0, -1, 1), "positive sizes"),
    ],
)
def test_sizes_of_a_mesh(sizes, expected):
    if isinstance(expected, tuple):
        assert MeshConfig(*sizes).shape(8) == expected
    else:
        with pytest.raises(UserError, match=expected):
            MeshConfig(*sizes).shape(8)


@pytest.mark.parametrize(
    ("processes", "expected"),
    [
        ([[0], [0], [1], [1]], (1, 2)),
        ([[0], [1], [0], [1]], (1, 2)),  # the hosts of a torus
        ([[0, 0], [1, 1]], (1, 2)),
        ([[0, 1], [0, 1]], (0, 1)),  # both hold all rows, and read the same
        ([[0, 1], [2, 3]], (0, 2)),
        ([[0], [0], [0], [1]], None),
        ([[0, 1], [0, 0]], None),
    ],
)
def test_which_part_of_a_batch_process_1_reads(processes, expected):
    if expected is None:
        with pytest.raises(UserError, match="cannot share a batch in equal parts"):
            part_of_process(np.array(processes), 1)
    else:
        assert part_of_process(np.array(processes), 1) == expected


def test_a_batch_that_does_not_divide_is_an_error_with_sizes_that_do():
    mesh = make_mesh(MeshConfig(1, 1, 1), jax.devices()[:1])
    part = batch_part(mesh, 6, 3)
    assert (part.index, part.count, part.size) == (0, 1, 6)
    with pytest.raises(
        UserError, match=r"batch_size: 8 does not divide .*gradient_accumulation 3.*--batch-size 6 or 9"
    ):
        batch_part(mesh, 8, 3)
