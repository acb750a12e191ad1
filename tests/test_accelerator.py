"""benchmarks/accelerator.py at toy size on a CPU, and what keeps its figures when something goes wrong."""

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks._accelerator.paper import one_device, paper_experiment, train_batch
from benchmarks._accelerator.report import Report, flat, table
from benchmarks._accelerator.sections import SECTIONS, SIZES, Job, Section, choose, problem_file
from benchmarks._accelerator.simulation import compare_pictures, starts
from benchmarks._accelerator.worker import run_sections
from benchmarks.accelerator import supervise
from benchmarks.accelerator_wheels import LOCK, PACKAGES, requirements
from data_pipelines.demos import generate_demonstrations
from dsvla_jax.encoding.encode import cloud_tokens
from dsvla_jax.encoding.number_targets import number_rows
from dsvla_jax.errors import UserError
from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.sim.environment import Environment, step
from dsvla_jax.sim.kinematics import track
from dsvla_jax.sim.robot import SINGLE_BASE
from dsvla_jax.sim.scene import build_scene
from dsvla_jax.sim.shifts import SHIFTS, Start, shift
from dsvla_jax.sim.tasks import get_task
from dsvla_jax.training.state import jit_train_step, make_optimizer
from dsvla_jax.types import Picture
from tests.accelerator_sections import platforms_expert, sections
from tests.learning import start_of, step_of
from tests.small import small_encoding
from tests.vocabularies import small_tokenizer

ROOT = Path(__file__).parent.parent
# Those that take most of the time: they decode, train a run, and trace MJX.
LONG = ("paper_7b_decode", "render", "tiny", "mjx_lamp_on", "mjx_stack_blocks", "equal_episodes")
FIGURES = {
    "devices": ("kind", "jax", "processors", "product_tflops"),
    "paper_7b_train": (
        *(f"batch 2/{name}" for name in ("seconds", "compile_seconds", "tokens_per_second", "examples_per_second")),
        *(f"batch 2/{name}" for name in ("tflops", "planned_gib", "held_gib", "peak_gib", "loss")),
        "batch 2, remat dots/seconds",
        "parameters",
        "weights/seconds",
    ),
    "paper_7b_decode": (
        *(f"robots 2/{name}" for name in ("milliseconds", "compile_seconds", "repeats")),
        "robots 2, int8/milliseconds",
    ),
    "points": ("clouds 2/clouds_per_second", "clouds 2/sampling/seconds", "clouds 2/tokenizer/seconds"),
    "render": ("lamp_on 16 px/frames_per_second",),
    "equal_pictures": ("sha256_cpu", "equal_pixels_share", "largest_colour_difference", "largest_depth_difference"),
    "tiny": ("steps_per_second", "train_seconds", "success", "success_lamp_on", "evaluation_seconds"),
    "mjx_lamp_on": (
        "policy",
        "compile_and_first_seconds",
        "episodes 2/keyframes_per_second",
        "episodes 2/episodes_per_second",
    ),
    "mjx_stack_blocks": ("episodes 2/keyframes_per_second", "episodes 2/success"),
    "equal_episodes": ("agree", "agree_with_c_mujoco", "succeed_device", "succeed_cpu", "compile_seconds"),
}


def measure(folder: Path, names: list[str], size: str = "toy", status: int = 0) -> tuple[dict[str, Any], str]:
    """The report of the named sections, and what was printed."""
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        # What is compiled runs a few times only.
        "XLA_FLAGS": "--xla_backend_optimization_level=0",
        "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".cache" / "xla"),
        "XDG_CACHE_HOME": str(folder / "cache"),
    }
    command = [sys.executable, "-m", "benchmarks.accelerator", "--size", size, "--out", str(folder / "out.json")]
    command += ["--folder", str(folder), "--seconds", "3000", "--sections", ",".join(names)]
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=3300)
    assert result.returncode == status, result.stdout + result.stderr
    return json.loads((folder / "out.json").read_text()), result.stdout


def require_figures(report: dict[str, Any], names: list[str]) -> None:
    assert list(report["sections"]) == names
    for name in names:
        section = report["sections"][name]
        assert (section["state"], section["error"]) == ("done", "")
        figures = dict(flat(section["figures"]))
        assert not [figure for figure in FIGURES[name] if figure not in figures]
        numbers = [value for value in figures.values() if isinstance(value, float)]
        assert np.isfinite(numbers).all()


def test_the_short_sections_give_their_figures(tmp_path: Path):
    names = [section.name for section in SECTIONS if section.name not in LONG]
    report, printed = measure(tmp_path, names)
    require_figures(report, names)
    pictures = report["sections"]["equal_pictures"]["figures"]
    assert pictures["equal"], "two processes on one CPU make the same pictures"
    assert (pictures["equal_pixels_share"], pictures["largest_depth_difference"]) == (1.0, 0.0)
    assert "batch 2/tokens_per_second" in printed.split("devices", 1)[1]


@pytest.mark.slow
def test_the_long_sections_give_their_figures(tmp_path: Path):
    report, _ = measure(tmp_path, list(LONG))
    require_figures(report, list(LONG))
    figures = {name: section["figures"] for name, section in report["sections"].items()}
    assert figures["tiny"]["steps"] == 4
    assert figures["mjx_lamp_on"]["policy"] == "trained", "by the section before"
    assert figures["equal_episodes"]["succeed_device"] == figures["equal_episodes"]["succeed_cpu"]


def test_without_an_accelerator_the_full_size_is_refused(tmp_path: Path):
    report, printed = measure(tmp_path, ["points", "render"], "full", status=1)
    message = "JAX has no accelerator here; on a CPU use --size toy"
    assert [section["error"] for section in report["sections"].values()] == [message] * 2
    assert printed.count(message) == 2


@pytest.mark.slow
def test_the_largest_programs_can_be_written_for_an_nvidia_gpu():
    """The paper's training step, whose weights exist as shapes only, and a keyframe in MJX."""
    full = paper_experiment("full")
    full = dataclasses.replace(full, batch_size=1, model=dataclasses.replace(full.model, attention="fused"))
    tokenizer, optimizer = small_tokenizer("sentencepiece"), make_optimizer(full.optimizer, full.steps)
    state, frozen = jax.eval_shape(partial(start_of, full, None, optimizer))
    targets = number_rows(tokenizer, full.encoding.style).targets(0.0)
    train_step = jit_train_step(step_of(full, optimizer, targets), state, one_device(full))
    environment, start = Environment("stack_blocks", "mjx"), starts("stack_blocks", 96, "eval", 1)
    move = jax.tree.map(lambda x: x[:, 0], environment.expert(start))
    for program, arguments in (
        (train_step, (state, frozen, train_batch(full, tokenizer, 1))),
        (jax.jit(partial(step, environment.scene)), (environment.physics, start, move)),
    ):
        text = program.trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()
        assert text.count("dot_general") > 10


def supervised(folder: Path, names: list[str], seconds: float) -> tuple[dict[str, Any], int]:
    """The report of sections of `tests.accelerator_sections`, and how many processes it took."""
    report, started = Report.start(folder / "out.json", names), []

    def start(waiting: list[str]) -> "subprocess.Popen[bytes]":
        started.append(waiting)
        command = [sys.executable, "-m", "tests.accelerator_sections", str(report.path), *waiting]
        return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)

    supervise(report, start, time.time(), time.time() + seconds)
    return json.loads(report.path.read_text())["sections"], len(started)


def test_a_section_that_fails_or_kills_its_process_loses_no_other(tmp_path: Path):
    report, processes = supervised(tmp_path, ["good", "broken", "killed", "last"], 300)
    assert {name: section["state"] for name, section in report.items()} == {
        "good": "done",
        "broken": "failed",
        "killed": "failed",
        "last": "done",
    }
    assert [section["figures"] for section in report.values()] == [
        {"answer": 42},
        {"half": 1},
        {"half": 2},
        {"answer": 43},
    ]
    assert report["broken"]["error"] == "ValueError: no such kernel"
    assert report["killed"]["error"] == "its process ended with status -9"
    assert processes == 3


def test_at_the_end_of_the_time_what_runs_is_stopped_and_keeps_its_figures(tmp_path: Path):
    report, processes = supervised(tmp_path, ["endless", "last"], 10)
    assert report["endless"]["figures"] == {"half": 3}
    assert report["endless"]["error"] == "stopped: no time was left"
    assert (report["last"]["state"], report["last"]["error"]) == ("skipped", "no time was left")
    assert processes == 1


def test_a_process_that_cannot_start_is_not_started_for_ever(tmp_path: Path):
    report = Report.start(tmp_path / "out.json", ["good", "last"])

    def start(waiting: list[str]) -> "subprocess.Popen[bytes]":
        return subprocess.Popen([sys.executable, "-c", "raise SystemExit(5)"])

    supervise(report, start, time.time(), time.time() + 300)
    states = [(one["state"], one["error"]) for one in Report(report.path).sections.values()]
    assert states == [("failed", "its process ended with status 5")] * 2


def test_a_section_for_which_too_little_time_is_left_is_skipped_and_a_short_one_still_runs(tmp_path: Path):
    chosen = [*sections("good", seconds=1000.0), *sections("last", seconds=1.0)]
    report, now = Report.start(tmp_path / "out.json", ["good", "last"]), time.time()
    assert run_sections(chosen, SIZES["full"], report, tmp_path, now, now + 100)
    found = Report(report.path).sections
    assert found["good"]["state"] == "skipped"
    assert found["good"]["error"].startswith("takes about 1000 s, ")
    assert (found["last"]["state"], found["last"]["figures"]) == ("done", {"answer": 43})
    assert "answer" in table(report, {"last": ("answer",)})


def test_what_the_cpu_could_not_prepare_ends_the_section_that_needs_it(tmp_path: Path):
    problem_file(tmp_path, "pictures").write_text("ValueError: no picture")
    job = Job(SIZES["toy"], tmp_path, lambda **_: None, lambda: 100.0, {})
    with pytest.raises(UserError, match="pictures: the CPU could not prepare them: ValueError: no picture"):
        job.prepared("pictures")


def test_sections_are_chosen_by_name():
    assert [section.name for section in choose(("render,devices", "tiny"))] == ["devices", "render", "tiny"]
    assert choose(("all",)) == list(SECTIONS)
    with pytest.raises(UserError, match="sections: unknown tinny; choose from all, devices, paper_7b_train"):
        choose(("tinny",))
    assert len({section.name for section in SECTIONS}) == len(SECTIONS) == len(FIGURES)
    assert all(isinstance(section, Section) and section.seconds > 0 for section in SECTIONS)


def test_pictures_are_compared_pixel_by_pixel():
    rgb = np.full((2, 4, 4, 3), 100, np.uint8)
    depth, geoms = np.ones((2, 4, 4), np.float32), np.zeros((2, 4, 4), np.int32)
    same = compare_pictures({"a": (rgb, depth, geoms)}, {"a": (rgb, depth, geoms)})
    assert (same["equal"], same["pictures"], same["equal_pixels_share"]) == (True, 2, 1.0)
    other_rgb, other_depth, other_geoms = rgb.copy(), depth.copy(), geoms.copy()
    other_rgb[0, 0, 0, 1] += 1
    other_rgb[1, 0, 0] = 110
    other_geoms[1, 0, 0], other_depth[1, 0, 0] = 7, 3.0  # another geom: its depth is no error
    other_depth[0, 3, 3] += 0.25
    other = compare_pictures({"a": (rgb, depth, geoms)}, {"a": (other_rgb, other_depth, other_geoms)})
    assert not other["equal"]
    assert other["equal_pixels_share"] == 1 - 2 / 32
    assert other["within_one_share"] == other["same_geom_share"] == 1 - 1 / 32
    assert (other["largest_colour_difference"], other["largest_depth_difference"]) == (10, 0.25)


def test_the_wheels_are_those_of_the_lock_file_for_the_other_machines_python():
    lines = requirements(LOCK.read_text(), PACKAGES, "3.12")
    assert [line.split("==")[0] for line in lines] == list(PACKAGES)
    assert all("--hash=sha256:" in line for line in lines)
    assert lines[PACKAGES.index("mujoco")].startswith("mujoco==3.17.0 ")
    newer, older = (requirements(LOCK.read_text(), ("jax",), python)[0] for python in ("3.12", "3.11"))
    assert newer.split()[0] != older.split()[0], "the lock has a version for each"
    with pytest.raises(UserError, match=r"packages: warp not in requirements\.lock"):
        requirements(LOCK.read_text(), ("warp",), "3.12")


def products(function: Callable[..., Any], *arguments: Any) -> list[Any]:
    """The precisions of all float32 matrix products of a function."""
    found: list[Any] = []

    def visit(jaxpr: Any) -> None:
        for equation in jaxpr.eqns:
            if equation.primitive.name == "dot_general" and equation.outvars[0].aval.dtype == jnp.float32:
                found.append(equation.params["precision"])
            for value in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
                if hasattr(value, "jaxpr"):
                    visit(value.jaxpr)
                elif hasattr(value, "eqns"):
                    visit(value)

    visit(jax.make_jaxpr(function)(*arguments).jaxpr)
    return found


def test_geometry_asks_accelerators_for_whole_float32_products():
    """Their default keeps ten bits or fewer: millimetres of a point, and a pixel of a picture."""
    camera, scene = front_camera(32), build_scene(get_task("lamp_on"), SHIFTS)
    pose = jnp.array([0.3, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0])
    start = Start(
        scene.initial, camera, jnp.ones(3), jnp.asarray(scene.mj_model.geom_size), jnp.asarray(scene.mj_model.geom_pos)
    )
    batch = jax.tree.map(lambda x: x[None, None], camera)
    seen = Picture(jnp.zeros((1, 1, 32, 32, 3), jnp.uint8), jnp.ones((1, 1, 32, 32)), batch)
    found = {
        "shifts": products(lambda key, start: shift(scene, key, start), jax.random.key(0), start),
        "kinematics": products(
            lambda pose: track(pose[None], jnp.zeros(7), jnp.array([*SINGLE_BASE, 0, 0, 0, 1], jnp.float32)),
            pose,
        ),
        "3D tokens": products(lambda seen: cloud_tokens(seen, small_encoding(stride=1)), seen),
    }
    highest = (jax.lax.Precision.HIGHEST,) * 2
    assert all(found.values())
    assert {name: set(precisions) for name, precisions in found.items()} == {name: {highest} for name in found}


def test_processes_that_demonstrate_leave_an_accelerator_to_the_first_one(tmp_path: Path):
    """The first process holds its memory, and each of the others would ask for as much."""
    with pytest.raises(UserError, match="platforms: cpu"):
        generate_demonstrations(
            tmp_path, ["lamp_on", "close_fridge"], 1, demonstrator=platforms_expert, workers=2, progress=False
        )
