"""The planner: what it reads from compiled programs, what it counts by hand, and what it says about bad input."""

import dataclasses
import importlib.util
import math
import subprocess
import sys
from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment, MeshConfig
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.flops import model_flops, training_flops
from dsvla_jax.model.variables import Regime
from dsvla_jax.planner.hlo import program_cost
from dsvla_jax.planner.meshes import parse_mesh
from dsvla_jax.planner.planning import needed_bytes, roofline
from dsvla_jax.training.chips import CHIPS, find_slice, peak_flops
from dsvla_jax.training.state import make_optimizer
from tests.learning import start_of, step_of
from tests.sharded_training import TARGETS, batches, tiny_experiment
from tests.test_sharding import ROOT

# A loop of 6 rounds as the TPU compiler writes it: a weight is gathered in three fusions that are one collective, a
# batched product is a dilated convolution, and a slice of a stacked weight is read in each round.
TPU_PROGRAM = """
HloModule jit_f, is_scheduled=true

%start (p: bf16[1,128,16]) -> bf16[1,512,16] {
  %p = bf16[1,128,16]{1,2,0:T(8,128)(2,1)} parameter(0)
  ROOT %all-gather.1 = bf16[1,512,16]{1,2,0:T(8,128)(2,1)} all-gather(%p), channel_id=14, dimensions={1}
}

%middle (p: bf16[1,128,16], x: bf16[2,4,64,128]) -> f32[2,4,64,64] {
  %p = bf16[1,128,16]{1,2,0:T(8,128)(2,1)} parameter(0)
  %x = bf16[2,4,64,128]{3,2,1,0:T(8,128)(2,1)S(1)} parameter(1)
  %all-gather.2 = bf16[1,512,16]{1,2,0:T(8,128)(2,1)} all-gather(%p), channel_id=14, dimensions={1}
  ROOT %product = f32[2,4,64,64]{2,3,1,0:T(8,128)S(1)} convolution(%x, %x), window={size=2x4 stride=1x3 lhs_dilate=2x4}, dim_labels=01bf_01oi->01bf, metadata={op_name="jit(f)/while/body/dot"}
}

%slice (w: bf16[6,128,16], i: s32[]) -> bf16[1,128,16] {
  %w = bf16[6,128,16]{1,2,0:T(8,128)(2,1)} parameter(0)
  %i = s32[]{:T(128)S(6)} parameter(1)
  %zero = s32[]{:T(128)} constant(0)
  ROOT %dynamic-slice.1 = bf16[1,128,16]{1,2,0:T(8,128)(2,1)} dynamic-slice(%w, %i, %zero, %zero), dynamic_slice_sizes={1,128,16}
}

%body (state: (s32[], bf16[6,128,16], bf16[2,4,64,128])) -> (s32[], bf16[6,128,16], bf16[2,4,64,128]) {
  %state = (s32[]{:T(128)}, bf16[6,128,16]{1,2,0:T(8,128)(2,1)}, /*index=2*/bf16[2,4,64,128]{3,2,1,0:T(8,128)(2,1)S(1)}) parameter(0)
  %i = s32[]{:T(128)} get-tuple-element(%state), index=0
  %w = bf16[6,128,16]{1,2,0:T(8,128)(2,1)} get-tuple-element(%state), index=1
  %x = bf16[2,4,64,128]{3,2,1,0:T(8,128)(2,1)S(1)} get-tuple-element(%state), index=2
  %wi = bf16[1,128,16]{1,2,0:T(8,128)(2,1)} fusion(%w, %i), kind=kLoop, calls=%slice
  %started = bf16[1,512,16]{1,2,0:T(8,128)(2,1)S(1)} fusion(%wi), kind=kCustom, calls=%start
  %used = f32[2,4,64,64]{2,3,1,0:T(8,128)S(1)} fusion(%wi, %x), kind=kOutput, calls=%middle
  ROOT %next = (s32[], bf16[6,128,16], bf16[2,4,64,128]) tuple(%i, %w, %x)
}

%condition (state: (s32[], bf16[6,128,16], bf16[2,4,64,128])) -> pred[] {
  %limit = s32[]{:T(128)} constant(6)
  %state = (s32[]{:T(128)}, bf16[6,128,16]{1,2,0:T(8,128)(2,1)}, bf16[2,4,64,128]{3,2,1,0:T(8,128)(2,1)S(1)}) parameter(0)
  %i = s32[]{:T(128)} get-tuple-element(%state), index=0
  ROOT %lt = pred[]{:T(512)} compare(%i, %limit), direction=LT
}

ENTRY %main (w: bf16[6,128,16], x: bf16[2,4,64,128]) -> bf16[6,128,16] {
  %w = bf16[6,128,16]{1,2,0:T(8,128)(2,1)} parameter(0)
  %x = bf16[2,4,64,128]{3,2,1,0:T(8,128)(2,1)S(1)} parameter(1)
  %start.0 = s32[]{:T(128)} constant(0)
  %copy.0 = s32[]{:T(128)} copy(%start.0)
  %init = (s32[], bf16[6,128,16], bf16[2,4,64,128]) tuple(%copy.0, %w, %x)
  %while.1 = (s32[], bf16[6,128,16], bf16[2,4,64,128]) while(%init), condition=%condition, body=%body
  ROOT %out = bf16[6,128,16]{1,2,0:T(8,128)(2,1)} get-tuple-element(%while.1), index=1
}
"""  # noqa: E501


def test_a_tpu_program_is_counted_by_its_loops():
    cost = program_cost(TPU_PROGRAM)
    assert cost.unknown_loops == 0
    assert cost.flops == 6 * 2 * (2 * 4) * 64 * 64 * 128, "zeros of a dilated convolution are no products"
    weight = 128 * 16 * 2
    assert cost.collectives == {"all-gather": 6 * 4 * weight}, "one collective, though three fusions name it"
    # A round reads a slice and the counter, writes the slice, and reads it twice; the rest stays on the chip. The
    # counter is copied once.
    assert cost.traffic == 6 * (4 * weight + 4) + 2 * 4


def test_a_loop_that_counts_by_more_than_one_runs_less_often():
    raised = "%two = s32[]{:T(128)} constant(2)\n  %up = s32[]{:T(128)} add(%i, %two)\n  ROOT %next"
    by_two = TPU_PROGRAM.replace("ROOT %next", raised).replace("tuple(%i, %w, %x)", "tuple(%up, %w, %x)")
    assert program_cost(by_two).flops * 2 == program_cost(TPU_PROGRAM).flops


def test_a_compiled_loop_of_products_is_counted_as_often_as_it_runs():
    def f(w, x):
        return jax.lax.scan(lambda x, w: (jnp.tanh(x @ w), None), x, w)[0]

    compiled = jax.jit(f).lower(jnp.zeros((5, 64, 64)), jnp.zeros((48, 64))).compile()
    cost = program_cost(compiled.as_text() or "")
    assert (cost.flops, cost.unknown_loops, cost.collectives) == (5 * 2 * 48 * 64 * 64, 0, {})


def dot_flops(jaxpr: Any) -> int:
    """FLOPs of the products that JAX traces, the bodies of loops by their length: an independent count."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (left, _), _ = equation.params["dimension_numbers"]
            inner = math.prod(equation.invars[0].aval.shape[axis] for axis in left)
            total += 2 * math.prod(equation.outvars[0].aval.shape) * inner
        times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        for inner in jax.extend.core.jaxprs_in_params(equation.params):
            total += times * dot_flops(inner)
    return total


def parts(experiment: Experiment) -> tuple[EncodingConfig, ModelConfig, Regime]:
    """What the FLOPs of an experiment are counted from."""
    return experiment.encoding, experiment.model, experiment.regime


def traced_flops(experiment: Experiment) -> int:
    """FLOPs of the products of one training step."""
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    state, frozen = jax.eval_shape(partial(start_of, experiment, None, optimizer))
    step = step_of(experiment, optimizer, TARGETS)
    batch = batches(experiment)[0]
    pictures = jax.tree.map(lambda x: np.repeat(x, experiment.model.cameras, axis=1), batch.pictures)
    batch = dataclasses.replace(batch, pictures=pictures)
    return dot_flops(jax.make_jaxpr(step)(state, frozen, batch).jaxpr)


def in_16_bits(fusion: Any) -> Experiment:
    """In 32, the sum of a matrix and its adapter may be formed: another way to the same result."""
    experiment = tiny_experiment(fusion)
    return dataclasses.replace(experiment, model=dataclasses.replace(experiment.model, dtype="bfloat16"))


@pytest.mark.parametrize(
    ("fusion", "regime", "remat"),
    [
        ("adapter", "lora", "full"),
        ("adapter", "adapters", "full"),
        ("adapter", "full", "dots"),
        ("adapter", "lora", "none"),
        ("prefix", "lora", "dots"),
        ("prefix", "full", "full"),
    ],
)
def test_flops_counted_by_hand_are_those_of_the_traced_step(fusion, regime, remat):
    experiment = in_16_bits(fusion)
    model = dataclasses.replace(experiment.model, remat=remat)
    experiment = dataclasses.replace(experiment, regime=regime, model=model)
    counted = sum(training_flops(*parts(experiment)).values()) * experiment.batch_size
    assert 0.97 < traced_flops(experiment) / counted < 1.03


@pytest.mark.parametrize("fusion", ["adapter", "prefix"])
def test_flops_of_two_cameras_are_those_of_the_traced_step(fusion):
    experiment = in_16_bits(fusion)
    experiment = dataclasses.replace(
        experiment,
        model=dataclasses.replace(experiment.model, cameras=2),
        data=dataclasses.replace(experiment.data, cameras=("front", "wrist")),
    )
    counted = sum(training_flops(*parts(experiment)).values()) * experiment.batch_size
    assert 0.97 < traced_flops(experiment) / counted < 1.03


def test_utilisation_does_not_count_what_is_computed_again():
    plain = in_16_bits("prefix")
    assert plain.model.remat == "none"
    again = dataclasses.replace(plain, model=dataclasses.replace(plain.model, remat="full"))
    assert 0.97 < traced_flops(plain) / (model_flops(*parts(again)) * again.batch_size) < 1.03
    assert model_flops(*parts(again)) < 0.9 * sum(training_flops(*parts(again)).values())


def test_a_peak_is_known_or_not_told():
    def devices(*kinds: str) -> list[Any]:
        return [SimpleNamespace(device_kind=kind) for kind in kinds]

    assert peak_flops(devices("TPU v5 lite", "TPU v5 lite")) == 2 * CHIPS["v5e"].flops
    assert peak_flops(devices("TPU v5 lite", "TPU v99")) is None
    assert peak_flops(jax.devices("cpu")) is None


@pytest.mark.parametrize(
    ("message", "needed"),
    [
        ("Ran out of memory in memory space hbm. Used 20.50G of 15.75G hbm. Exceeded", 20.5 * 2**30),
        (
            "CompileTimeHbmOom: Ran out of memory on HBM, the total memory required for HLO temporaries (18.50G) "
            "exceeds available HBM (15.75G). HLO module:",
            18.5 * 2**30,
        ),
        ("INTERNAL: Mosaic failed to compile a kernel", None),
    ],
)
def test_what_does_not_fit_is_read_from_the_compilers_error(message: str, needed: float | None):
    assert needed_bytes(message) == needed


@pytest.mark.skipif(importlib.util.find_spec("libtpu") is None, reason="needs the TPU compiler")
@pytest.mark.parametrize(("name", "chip"), [("v4:2x2x1", "v4"), ("v5e:2x2", "v5e"), ("v5p:2x2x1", "v5p")])
def test_the_names_of_tpus_are_those_that_the_compiler_gives(name, chip):
    program = "import sys; from dsvla_jax.training.chips import *; d, *_ = find_slice(sys.argv[1]).devices"
    command = [sys.executable, "-c", f"{program}; print(peak_flops([d]))", name]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert result.stdout.split()[-1:] == [str(CHIPS[chip].flops)], result.stderr


def test_seconds_at_the_peaks():
    chip = CHIPS["v5e"]
    low, high = roofline(chip, 197e12, 819e9 / 2, 200e9 / 4)
    assert (low, high) == (1.0, 1.75)


def test_sizes_of_a_mesh_as_text():
    assert parse_mesh("data=2,fsdp=-1") == MeshConfig(2, -1, 1)
    for wrong in ("data=2;fsdp=8", "model=2", "fsdp=all"):
        with pytest.raises(UserError, match=r"expected sizes such as data=1,fsdp=-1,tensor=1"):
            parse_mesh(wrong)


@pytest.mark.parametrize("name", ["v5e", "v5e:4", "h100:8x8", "v5e:4xx4"])
def test_a_slice_that_is_none_is_an_error_with_an_example(name):
    with pytest.raises(UserError, match=r"expected a chip of v4, .* e.g. v5e:4x4"):
        find_slice(name)


@pytest.mark.slow
@pytest.mark.parametrize("config", ["tiny_lora", "dp3"])
def test_the_planner_plans_on_virtual_devices(config: str):
    command = [sys.executable, "plan.py", f"configs/{config}.py", "--topology", "v5e:2x2"]
    # Without site packages' libtpu there are virtual CPU devices.
    hide = (
        "import importlib.util as u; f = u.find_spec; u.find_spec = lambda n, *a: None if n == 'libtpu' else f(n, *a)"
    )
    run = "import runpy, sys; sys.argv = sys.argv[1:]; runpy.run_path('plan.py', run_name='__main__')"
    command = [sys.executable, "-c", f"{hide}; {run}", *command[2:], "--mesh", "fsdp=-1", "--examples", "2"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert result.returncode == 0, result.stderr
    assert (
        "training step on v5e:2x2 (virtual CPU devices): data 1, fsdp 4, tensor 1; 2 examples a chip" in result.stdout
    )
    assert "decoding on v5e:2x2" in result.stdout
    assert "all-gather" in result.stdout
