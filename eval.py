"""Evaluate a run in closed loop: python eval.py RUN [--tasks all] [--episodes 25] [--physics mjx] [--compare RUN ...]

Every episode starts from a seed that no demonstration used. Prints success rates with Wilson 95 % intervals and writes,
in RUN/eval, one line of JSON an episode and an HTML report with a film strip of each.
"""

import dataclasses
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tyro

import dsvla_jax.policy
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.errors import UserError
from dsvla_jax.files import write_picture
from dsvla_jax.model.decode import Decoding
from dsvla_jax.policy import Policy
from dsvla_jax.report import (
    EpisodeResult,
    film_strip,
    mark_targets,
    print_comparison,
    print_table,
    read_results,
    write_report,
    write_results,
)
from dsvla_jax.rollout import Ending, run_task
from dsvla_jax.rollout_keypoints import Keypoints, keypoint_source
from dsvla_jax.sim.episode import Environment
from dsvla_jax.sim.shifts import check_shifts
from dsvla_jax.sim.tasks import select_tasks
from dsvla_jax.training.experiment import Experiment, load_experiment


@dataclasses.dataclass(frozen=True)
class Options:
    """Closed-loop evaluation of a trained run."""

    run: tyro.conf.Positional[Path]
    """The run folder that train.py wrote."""
    physics: Literal["mujoco", "mjx"] = "mujoco"
    """C MuJoCo on the processor, or vectorised MJX on whatever device JAX has."""
    tasks: tuple[str, ...] = ()
    """Names (with spaces or commas between), all, single_arm or dual_arm; those the run was trained on if not given."""
    episodes: int | None = None
    """Unseen episodes a task; the config's number if not given."""
    batch: int = 100
    """Most episodes side by side."""
    keypoints: Keypoints | None = None
    """What the policy is told to go near, as in its training if not given: the task's own points as they are at the
    start (oracle); those found in the first picture, by the simulator's masks and the depth on them (segmentation;
    paper, section 3.3); or those found in the picture before every key pose, hidden objects where they were last seen
    (segmentation-refresh)."""
    keypoint_noise: float = 0.0
    """Metres of uniform noise an axis on every keypoint (paper, section 4.3: up to 0.1)."""
    shift: tuple[str, ...] = ()
    """Test conditions unlike those of training (paper, Table 4): instance, position, background, camera."""
    choice: Literal["greedy", "expected"] = "greedy"
    """Take the most probable integer of each number, or the one nearest to its mean."""
    step: int | Literal["best"] | None = None
    """The checkpoint to evaluate: its step, or the best by its score in training; the newest if not given."""
    seed: int = 0
    skip_finished: bool = False
    """Leave the tasks as they are that have been evaluated since the last training."""
    compare: tuple[Path, ...] = ()
    """Other runs: evaluates nothing, prints what is in RUN/eval and theirs side by side."""


def main(options: Options) -> None:
    """Evaluates, prints the table, writes results and report."""
    if options.compare:
        runs = (options.run, *options.compare)
        print_comparison({str(run): read_results(results_file(run, options)) for run in runs})
        return
    if not (options.run / "config.json").exists():
        raise UserError(f"{options.run}: no run here (config.json is missing); train one: python train.py CONFIG")
    experiment = load_experiment(options.run / "config.json")
    tasks = select_tasks(options.tasks or experiment.data.tasks)
    episodes = options.episodes or experiment.evaluation.episodes
    file = results_file(options.run, options)
    kept = finished_results(file, options.run, episodes) if options.skip_finished else []
    missing = [name for name in tasks if name not in {result.task for result in kept}]
    results = kept
    if missing:
        policy = dsvla_jax.policy.load(options.run, decoding=Decoding(options.choice), step=options.step)
        if options.keypoints and not policy.config.encoding.use_keypoints:
            raise UserError(f"{options.run}: trained without keypoints; leave out --keypoints {options.keypoints}")
        for name in missing:
            endings = evaluate_task(policy, experiment, name, episodes, options)
            save_strips(file, name, endings)
            results = results + [
                EpisodeResult(name, i, options.physics, e.success, e.reason, e.keyframes, e.instruction, e.answers)
                for i, e in enumerate(endings)
            ]
            write_results(file, results)
    else:
        print(f"{file} is newer than the training and complete: nothing to do")
    print_table(results)
    report = file.with_suffix(".html")
    if missing or not report.exists():
        other = results_file(options.run, dataclasses.replace(options, physics=other_physics(options.physics)))
        strips = load_strips(file, results)
        write_report(report, results, strips, read_results(other) if other.exists() else None, title=str(options.run))
    print(f"report: {report}")


def results_file(run: Path, options: Options) -> Path:
    """Where the results of these conditions are kept; the physics alone name the plain ones."""
    keypoints = f"-keypoints-{options.keypoints}" if options.keypoints else ""
    noise = f"-keypoint-noise-{options.keypoint_noise:g}" if options.keypoint_noise else ""
    shifts = "".join(f"-{name}" for name in check_shifts(options.shift))
    choice = f"-{options.choice}" if options.choice != "greedy" else ""
    seed = f"-seed-{options.seed}" if options.seed else ""
    step = f"-step-{options.step}" if options.step is not None else ""
    return run / "eval" / f"{options.physics}{keypoints}{noise}{shifts}{choice}{seed}{step}.jsonl"


def other_physics(physics: str) -> str:
    """The kind of physics to compare with."""
    return "mjx" if physics == "mujoco" else "mujoco"


def finished_results(file: Path, run: Path, episodes: int) -> list[EpisodeResult]:
    """What the file holds of tasks evaluated on at least so many episodes since the last training."""
    if not file.exists() or file.stat().st_mtime < (run / "metrics.jsonl").stat().st_mtime:
        return []
    results = read_results(file)
    count = Counter(result.task for result in results)
    return [result for result in results if count[result.task] >= episodes]


def evaluate_task(policy: Policy, experiment: Experiment, name: str, episodes: int, options: Options) -> list[Ending]:
    """All episodes of one task, ``options.batch`` of them side by side."""
    environment = Environment(
        name, physics=options.physics, image_size=experiment.data.image_size, shifts=options.shift
    )
    return run_task(
        environment,
        policy.act,
        episodes,
        split="eval",
        seed=options.seed,
        batch=options.batch,
        keypoint_noise=options.keypoint_noise,
        find_keypoints=keypoint_source(options.keypoints or experiment.keypoints, environment),
        label=f"{name} ({options.physics})",
    )


def save_strips(file: Path, task: str, endings: Sequence[Ending]) -> None:
    """Writes the film strip of every episode beside the results, each target marked in the frame it was answered to."""
    folder = file.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    for i, ending in enumerate(endings):
        marked = [mark_targets(f, t, ending.camera) for f, t in zip(ending.frames, ending.targets, strict=False)]
        write_picture(folder / f"{task}-{i}.png", film_strip([*marked, ending.frames[-1]]))


def load_strips(file: Path, results: Sequence[EpisodeResult]) -> dict[tuple[str, int], list[np.ndarray]]:
    """The film strips of the results that have one, as `write_report` takes them."""
    paths = {(r.task, r.seed): file.with_suffix("") / f"{r.task}-{r.seed}.png" for r in results}
    pictures = {key: cv2.imread(str(path)) for key, path in paths.items()}
    return {key: [picture[..., ::-1]] for key, picture in pictures.items() if picture is not None}


if __name__ == "__main__":
    with fail_with_message():
        parsed = tyro.cli(Options, prog="eval.py", description=__doc__)
        configure_jax(parsed.physics)
        started = time.monotonic()
        main(parsed)
        print(f"{time.monotonic() - started:.0f} s", file=sys.stderr)
