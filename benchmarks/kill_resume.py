"""A run killed with SIGKILL 20 times, during saves too, ends exactly as one left alone (8 minutes).

Usage: python -m benchmarks.kill_resume [--kills 20] [--folder DIR]
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
import tyro

from dsvla_jax.command_line import fail_with_message
from dsvla_jax.errors import UserError

ROOT = Path(__file__).parent.parent
CHECKPOINT_EVERY = 8
# The whole policy at the smallest size that has every part.
CONFIG = f"""
tiny --log-every 1 --checkpoint-every {CHECKPOINT_EVERY} --batch-size 4 --data.tasks lamp_on --data.episodes 4
--data.image-size 32 --encoding.image-size 32 --encoding.patch-size 16 --encoding.points.num-points 64
--encoding.points.group-sizes 16 4 --encoding.points.neighbours 4 --encoding.points.width 32
--model.vision.image-size 32 --model.vision.patch-size 16 --model.vision.width 32 --model.vision.layers 1
--model.vision.heads 2 --model.language.width 32 --model.language.layers 1 --model.language.heads 2
--model.language.kv-heads 2 --model.language.ffn 64 --model.scan-unroll 1
""".split()
# What depends on the machine and not on the training.
TIMINGS = (
    "seconds_per_step",
    "examples_per_second",
    "tokens_per_second",
    "data_wait_share",
    "model_tflops_per_second",
    "host_memory_gib",
)


@dataclasses.dataclass(frozen=True)
class Options:
    """How often, and where."""

    kills: int = 20
    folder: Path | None = None
    """Where the demonstrations and the two runs go; a temporary folder if not given."""
    seed: int = 0


def start(folder: Path, run: str, steps: int) -> subprocess.Popen[bytes]:
    """train.py, as a person starts it: the same command every time."""
    command = [sys.executable, str(ROOT / "train.py"), *CONFIG, "--steps", str(steps), "--run", run]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    with (folder / f"{run}.log").open("ab") as log:
        return subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)


def wait_for(process: subprocess.Popen[bytes], reached: Callable[[], bool]) -> None:
    """Looks again and again until it is so, or the process is over."""
    while process.poll() is None and not reached():
        time.sleep(0.002)


def last_step(run: Path) -> int:
    """The newest step in metrics.jsonl."""
    try:
        lines = (run / "metrics.jsonl").read_text().splitlines()
        return json.loads(lines[-1])["step"] if lines else 0
    except (FileNotFoundError, ValueError):
        return 0


def kill_at_random(process: subprocess.Popen[bytes], run: Path, rng: np.random.Generator) -> str:
    """Kills during start-up, between steps, or while a checkpoint is written. Returns which."""
    kind = str(rng.choice(["start", "step", "step", "save", "save"]))
    began = time.monotonic()
    if kind == "start":
        delay, before = rng.uniform(0, 15), last_step(run)
        wait_for(process, lambda: time.monotonic() - began > delay or last_step(run) > before)
    elif kind == "step":
        target = last_step(run) + int(rng.integers(1, 2 * CHECKPOINT_EVERY))
        wait_for(process, lambda: last_step(run) >= target)
    else:
        saves = run / "checkpoints"
        old = {path.name for path in saves.glob("*tmp")}
        wait_for(process, lambda: any(path.name not in old for path in saves.glob("*tmp")))
        began, delay = time.monotonic(), rng.uniform(0, 0.3)
        wait_for(process, lambda: time.monotonic() - began > delay)
    process.kill()
    process.wait()
    writing = len(list((run / "checkpoints").glob("*tmp")))
    return f"{kind}, at step {last_step(run)}" + (", a checkpoint half written" if writing else "")


def lines_of(run: Path) -> list[dict[str, float]]:
    """metrics.jsonl without what depends on the machine."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name not in TIMINGS} for line in lines]


def arrays_of(run: Path, step: int) -> list[np.ndarray]:
    """All arrays of a checkpoint."""
    with ocp.PyTreeCheckpointer() as checkpointer:
        trees = [checkpointer.restore(run / "checkpoints" / str(step) / name) for name in ("trainable", "optimizer")]
    return [np.asarray(leaf) for leaf in jax.tree.leaves(trees)]


def main(options: Options, folder: Path) -> int:
    # A step kill advances by 4 saved steps on average, a kill during a save by what a quick machine does in 0.3 s.
    steps = CHECKPOINT_EVERY * (2 * options.kills + 3)
    calm = start(folder, "calm", steps)
    if calm.wait() != 0:
        raise UserError(f"the run left alone failed; see {folder / 'calm.log'}")
    rng = np.random.default_rng(options.seed)
    for kill in range(options.kills):
        process = start(folder, "killed", steps)
        told = kill_at_random(process, folder / "killed", rng)
        if process.returncode != -9:
            raise UserError(
                f"expected the run to be alive, it ended with {process.returncode}; see {folder}/killed.log"
            )
        print(f"kill {kill + 1}: {told}", flush=True)
    if start(folder, "killed", steps).wait() != 0:
        raise UserError(f"the last restart failed; see {folder / 'killed.log'}")

    one, other = lines_of(folder / "calm"), lines_of(folder / "killed")
    differing = sum(a != b for a, b in zip(one, other, strict=False)) + abs(len(one) - len(other))
    arrays = list(zip(arrays_of(folder / "calm", steps), arrays_of(folder / "killed", steps), strict=True))
    unequal = sum(not np.array_equal(a, b) for a, b in arrays)
    print(
        f"{options.kills} kills, {steps} steps: {differing} of {len(one)} lines of metrics differ, {unequal} of "
        f"{len(arrays)} arrays of the last checkpoint differ (expected 0 and 0)"
    )
    return int(differing > 0 or unequal > 0)


if __name__ == "__main__":
    with fail_with_message(), tempfile.TemporaryDirectory() as temporary:
        parsed = tyro.cli(Options, description=__doc__)
        place = parsed.folder or Path(temporary)
        place.mkdir(parents=True, exist_ok=True)
        sys.exit(main(parsed, place.absolute()))
