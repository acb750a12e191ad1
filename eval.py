"""Evaluate a run in closed loop: python eval.py RUN [--tasks all] [--episodes 25] [--physics mjx] [--compare RUN ...]

Every episode starts from a seed that no demonstration used. Prints success rates with Wilson 95 % intervals and writes,
in RUN/eval, one line of JSON an episode and an HTML report with a film strip of each. Results of other tasks stay.
Results of another checkpoint that are replaced move to the file that --step names.
"""

import contextlib
import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import tyro

import dsvla_jax.policy
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.command_line import configure_jax, fail_with_message, parse_options
from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.report import (
    EpisodeResult,
    film_strip,
    mark_targets,
    merge_results,
    print_comparison,
    print_table,
    read_results,
    require_writable,
    write_report,
    write_results,
)
from dsvla_jax.evaluation.rollout import Ending, run_task
from dsvla_jax.experiment import Experiment, load_experiment, require_simulated
from dsvla_jax.files import write_picture
from dsvla_jax.model.decode import Decoding
from dsvla_jax.perception.simulator import Keypoints, keypoint_source
from dsvla_jax.policy import Policy
from dsvla_jax.ranges import at_least, check_fields
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.shifts import check_shifts
from dsvla_jax.sim.tasks import select_tasks


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
    """Another number gives other episodes."""
    skip_finished: bool = False
    """Evaluate only tasks that lack results of this checkpoint under these conditions."""
    compare: tuple[Path, ...] = ()
    """Other runs: evaluates nothing, prints what is in RUN/eval and theirs side by side."""
    out: Path | None = None
    """The folder for results and report; RUN/eval if not given."""

    def __post_init__(self) -> None:
        check_fields(
            self,
            "",
            episodes=at_least(1),
            batch=at_least(1),
            keypoint_noise=at_least(0),
            step=at_least(0),
            seed=at_least(0),
        )

    @property
    def results(self) -> Path:
        """The folder for results."""
        return self.out or self.run / "eval"


def main(options: Options) -> None:
    """Evaluates, prints the table, writes results and report."""
    if options.compare:
        files = {options.run: results_file(options.results, options)}
        files |= {run: results_file(run / "eval", options) for run in options.compare}
        print_comparison({str(run): read_results(file) for run, file in files.items()})
        return
    if not (options.run / "config.json").exists():
        raise UserError(f"{options.run}: no run here (config.json is missing); train one: python train.py CONFIG")
    experiment = load_experiment(options.run / "config.json")
    require_simulated(experiment, options.run)
    tasks = select_tasks(options.tasks or experiment.data.tasks)
    episodes = experiment.evaluation.episodes if options.episodes is None else options.episodes
    file = results_file(options.results, options)
    with contextlib.closing(RunCheckpoints(options.run, read_only=True)) as checkpoints:
        step, digest = checkpoints.identify(options.step)
    conditions = {"step": step, "digest": digest, **conditions_of(options, experiment)}
    results = read_results(file) if file.exists() else []
    finished = finished_tasks(results, conditions, episodes) if options.skip_finished else set()
    missing = [name for name in tasks if name not in finished]
    if missing:
        require_writable(options.results)
        policy = dsvla_jax.policy.load(options.run, decoding=Decoding(options.choice), step=step)
        if options.keypoints and not policy.config.encoding.use_keypoints:
            raise UserError(f"{options.run}: trained without keypoints; leave out --keypoints {options.keypoints}")
        for name in missing:
            endings = evaluate_task(policy, experiment, name, episodes, options)
            fresh = [
                EpisodeResult(
                    name, i, options.physics, e.success, e.reason, e.keyframes, e.instruction, e.answers, conditions
                )
                for i, e in enumerate(endings)
            ]
            results, displaced = merge_results(results, fresh)
            set_aside(file, options, displaced)
            write_results(file, results)
            save_strips(file, name, endings)
    else:
        print(f"{file} holds {episodes} episodes of each task at step {step}: nothing to do")
    print_table([result for result in results if result.task in tasks])
    report = file.with_suffix(".html")
    if missing or not report.exists():
        other = results_file(options.results, dataclasses.replace(options, physics=other_physics(options.physics)))
        strips = load_strips(file, results)
        write_report(report, results, strips, read_results(other) if other.exists() else None, title=str(options.run))
    print(f"report: {report}")


def results_file(folder: Path, options: Options, step: object = None) -> Path:
    """Where the results of these conditions are kept; the physics alone name the plain ones. step: overrides --step."""
    keypoints = f"-keypoints-{options.keypoints}" if options.keypoints else ""
    noise = f"-keypoint-noise-{options.keypoint_noise:g}" if options.keypoint_noise else ""
    shifts = "".join(f"-{name}" for name in check_shifts(options.shift))
    choice = f"-{options.choice}" if options.choice != "greedy" else ""
    seed = f"-seed-{options.seed}" if options.seed else ""
    step = options.step if step is None else step
    at = f"-step-{step}" if step is not None else ""
    return folder / f"{options.physics}{keypoints}{noise}{shifts}{choice}{seed}{at}.jsonl"


def other_physics(physics: str) -> str:
    """The kind of physics to compare with."""
    return "mjx" if physics == "mujoco" else "mujoco"


def conditions_of(options: Options, experiment: Experiment) -> dict[str, Any]:
    """What an episode's outcome depends on besides the checkpoint and its own number."""
    return {
        "physics": options.physics,
        "keypoints": options.keypoints or experiment.keypoints,
        "keypoint_noise": options.keypoint_noise,
        "shifts": list(check_shifts(options.shift)),
        "seed": options.seed,
        "choice": options.choice,
        "image_size": experiment.data.image_size,
    }


def finished_tasks(results: Sequence[EpisodeResult], conditions: dict[str, Any], episodes: int) -> set[str]:
    """The tasks that have so many episodes under these conditions."""
    measured = {(result.task, result.seed) for result in results if result.conditions == conditions}
    return {task for task, _ in measured if all((task, seed) in measured for seed in range(episodes))}


def set_aside(file: Path, options: Options, displaced: Sequence[EpisodeResult]) -> None:
    """Moves results and film strips of other checkpoints to the files that --step names."""
    for step in dict.fromkeys(result.conditions.get("step", "unknown") for result in displaced):
        theirs = [result for result in displaced if result.conditions.get("step", "unknown") == step]
        target = results_file(file.parent, options, step)
        if target == file:
            continue  # the run was trained anew: no checkpoint has these results any more
        merged, _ = merge_results(read_results(target) if target.exists() else [], theirs)
        write_results(target, merged)
        target.with_suffix("").mkdir(exist_ok=True)
        for result in theirs:
            strip = strip_file(file, result.task, result.seed)
            if strip.exists():
                strip.replace(strip_file(target, result.task, result.seed))


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


def strip_file(file: Path, task: str, seed: int) -> Path:
    """Where the film strip of an episode is, beside the file of its result."""
    return file.with_suffix("") / f"{task}-{seed}.png"


def save_strips(file: Path, task: str, endings: Sequence[Ending]) -> None:
    """Writes the film strip of every episode beside the results, each target marked in the frame it was answered to."""
    file.with_suffix("").mkdir(parents=True, exist_ok=True)
    for i, ending in enumerate(endings):
        marked = [mark_targets(f, t, ending.camera) for f, t in zip(ending.frames, ending.targets, strict=False)]
        write_picture(strip_file(file, task, i), film_strip([*marked, ending.frames[-1]]))


def load_strips(file: Path, results: Sequence[EpisodeResult]) -> dict[tuple[str, int], list[np.ndarray]]:
    """The film strips of the results that have one, as `write_report` takes them."""
    paths = {(r.task, r.seed): strip_file(file, r.task, r.seed) for r in results}
    pictures = {key: cv2.imread(str(path)) for key, path in paths.items() if path.exists()}
    return {key: [picture[..., ::-1]] for key, picture in pictures.items() if picture is not None}


def program() -> None:
    """Runs the program: `python eval.py`, or `dsvla-eval` where the project is installed."""
    with fail_with_message():
        parsed = parse_options(Options, prog="eval.py", description=__doc__)
        configure_jax(parsed.physics)
        started = time.monotonic()
        main(parsed)
        print(f"{time.monotonic() - started:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    program()
