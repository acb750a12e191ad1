"""Evaluate a run in closed loop: python eval.py RUN [--tasks all] [--episodes 25] [--physics mjx] [--compare RUN ...]

Every episode starts from a seed that no demonstration used. Prints success rates with Wilson 95 % intervals and writes,
in RUN/eval, one line of JSON an episode (results.jsonl), with the conditions it was run under, and an HTML report with
a film strip of each. Results of other tasks, conditions and checkpoints stay.
"""

import contextlib
import dataclasses
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tyro

import dsvla_jax.policy
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.command_line import configure_jax, fail_with_message, parse_options
from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.conditions import Conditions
from dsvla_jax.evaluation.device_loop import DeviceLoop
from dsvla_jax.evaluation.loop import on_host, run_task
from dsvla_jax.evaluation.outcome import EpisodeOutcome
from dsvla_jax.evaluation.pictures import film_strip, mark_view
from dsvla_jax.evaluation.report import print_comparison, print_table, write_report
from dsvla_jax.evaluation.results import (
    EpisodeResult,
    finished_tasks,
    latest,
    merge_results,
    read_results,
    require_writable,
    write_results,
)
from dsvla_jax.evaluation.seeing import read_errors
from dsvla_jax.evaluation.withheld import check_parts, withholding
from dsvla_jax.experiment import Experiment, load_experiment, require_simulated
from dsvla_jax.files import write_picture
from dsvla_jax.model.decode import Decoding
from dsvla_jax.perception.simulator import Keypoints, keypoint_source
from dsvla_jax.policies.interface import Policy
from dsvla_jax.ranges import at_least, check_fields, require
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
    loop: Literal["host", "device"] = "host"
    """Where the closed loop runs: on the host, which asks the policy before every keyframe, or on the device, as one
    jitted program for a whole batch of episodes. The latter requires --physics mjx, finds keypoints once, and keeps the
    last view alone."""
    tasks: tuple[str, ...] = ()
    """Names (with spaces or commas between), all, single_arm or dual_arm; those the run was trained on if not given."""
    episodes: int | None = None
    """Unseen episodes a task; the config's number if not given."""
    batch: int = 100
    """Most episodes side by side."""
    keypoints: Keypoints | None = None
    """What the policy is told to go near, as in its training if not given: the task's own points as they are at the
    start (oracle); those found in the first picture, by the simulator's masks and the depth on them (segmentation;
    paper, section 3.3); or those found in the picture before every keyframe, hidden objects where they were last seen
    (segmentation-refresh)."""
    keypoint_noise: float = 0.0
    """Metres of uniform noise an axis on every keypoint (paper, section 4.3: up to 0.1)."""
    shift: tuple[str, ...] = ()
    """Test conditions unlike those of training (paper, Table 4): instance, position, background, camera."""
    withhold: tuple[str, ...] = ()
    """Parts of its observations that the policy is denied: colour (grey pictures), depth (no points), keypoint, or
    own_pictures (it gets those of another episode)."""
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
        if self.loop == "device":
            require(self.physics == "mjx", "loop", "'host' with physics 'mujoco'", "'device'", "add --physics mjx")
            found = "found before every keyframe"
            require(not self.withhold, "loop", "'host' with inputs withheld", "'device'", "leave out --withhold")
            once = self.keypoints != "segmentation-refresh"
            require(once, "loop", f"'host' with keypoints that are {found}", "'device'", "use --keypoints segmentation")

    @property
    def results(self) -> Path:
        """The folder for results."""
        return self.out or self.run / "eval"


def main(options: Options) -> None:
    """Evaluates, prints the table, writes results and report."""
    if options.compare:
        print_comparison({str(run): compared(run, options) for run in (options.run, *options.compare)})
        return
    if not (options.run / "config.json").exists():
        raise UserError(f"{options.run}: no run here (config.json is missing); train one: python train.py CONFIG")
    experiment = load_experiment(options.run / "config.json")
    require_simulated(experiment, options.run)
    if experiment.baseline is not None and options.choice != "greedy":
        raise UserError(f"--choice: {experiment.baseline.kind} answers with poses, not with integers; leave it out")
    tasks = select_tasks(options.tasks or experiment.data.tasks)
    episodes = experiment.evaluation.episodes if options.episodes is None else options.episodes
    with contextlib.closing(RunCheckpoints(options.run, read_only=True)) as checkpoints:
        step, digest = checkpoints.identify(options.step)
    conditions = conditions_of(options, experiment, step, digest)
    folder, strips = options.results, options.results / "strips" / conditions.name
    results = read_results(folder)
    finished = finished_tasks(results, conditions, episodes) if options.skip_finished else set()
    missing = [name for name in tasks if name not in finished]
    if missing:
        require_writable(folder)
        policy = dsvla_jax.policy.load_policy(options.run, decoding=Decoding(options.choice), step=step)
        if options.keypoints and not policy.config.encoding.use_keypoints:
            raise UserError(f"{options.run}: trained without keypoints; leave out --keypoints {options.keypoints}")
        for name in missing:
            outcomes = evaluate_task(policy, experiment, name, episodes, options)
            fresh = [
                EpisodeResult(name, i, one.success, one.reason, one.keyframes, one.instruction, one.answers, conditions)
                for i, one in enumerate(outcomes)
            ]
            results = merge_results(results, fresh)
            write_results(folder, results)
            save_strips(strips, name, outcomes)
    else:
        print(f"{folder} holds {episodes} episodes of each task at step {step}: nothing to do")
    shown = latest(results, conditions.__eq__)
    print_table([result for result in shown if result.task in tasks])
    other = dataclasses.replace(conditions, physics="mjx" if options.physics == "mujoco" else "mujoco", loop="host")
    report = folder / "report.html"
    write_report(
        report,
        shown,
        load_strips(strips, shown),
        latest(results, other.__eq__) or None,
        withheld=by_withheld(results, conditions),
        errors=read_errors(folder, digest),
        title=str(options.run),
    )
    print(f"report: {report}")


def by_withheld(results: Sequence[EpisodeResult], conditions: Conditions) -> list[list[EpisodeResult]]:
    """Results under conditions that differ from these in what is withheld alone, a list for each."""
    others = dict.fromkeys(one.conditions.withheld for one in results if one.conditions.withheld != conditions.withheld)
    found = [latest(results, dataclasses.replace(conditions, withheld=parts).__eq__) for parts in others]
    return [some for some in found if some]


def conditions_of(options: Options, experiment: Experiment, step: int, digest: str) -> Conditions:
    """The conditions of an evaluation. step, digest: of the checkpoint."""
    return Conditions(
        step=step,
        digest=digest,
        physics=options.physics,
        loop=options.loop,
        keypoints=options.keypoints or experiment.keypoints,
        keypoint_noise=options.keypoint_noise,
        shifts=check_shifts(options.shift),
        withheld=check_parts(options.withhold),
        seed=options.seed,
        choice=options.choice,
        image_size=experiment.data.image_size,
    )


def compared(run: Path, options: Options) -> list[EpisodeResult]:
    """The results of a run under the conditions that the options name, of each task the latest.

    Raises UserError if there are none.
    """
    folder = options.results if run == options.run else run / "eval"
    wanted = {
        "physics": options.physics,
        "loop": options.loop,
        "keypoint_noise": options.keypoint_noise,
        "shifts": check_shifts(options.shift),
        "withheld": check_parts(options.withhold),
        "seed": options.seed,
        "choice": options.choice,
        **({"step": options.step} if isinstance(options.step, int) else {}),
    }
    config, keypoints = run / "config.json", options.keypoints
    if keypoints is None and config.exists():
        keypoints = load_experiment(config).keypoints

    def matches(found: Conditions) -> bool:
        return wanted.items() <= vars(found).items() and (keypoints is None or found.keypoints in ("", keypoints))

    results = latest(read_results(folder), matches)
    if not results:
        given = [f"{name} {value}" for name, value in _asked(options)]
        command = " --".join([f"python eval.py {run}", *given])
        raise UserError(f"{folder}: no results under these conditions; evaluate first: {command}")
    return results


def _asked(options: Options) -> Iterator[tuple[str, str]]:
    """The options that name other conditions than those of a plain evaluation, as on the command line."""
    for name in ("physics", "loop", "keypoints", "keypoint_noise", "shift", "withhold", "choice", "step", "seed"):
        value, plain = getattr(options, name), getattr(Options, name)
        if value != plain:
            yield name.replace("_", "-"), " ".join(value) if isinstance(value, tuple) else str(value)


def evaluate_task(
    policy: Policy, experiment: Experiment, name: str, episodes: int, options: Options
) -> list[EpisodeOutcome]:
    """All episodes of one task, ``options.batch`` of them side by side."""
    environment = Environment(
        name,
        physics=options.physics,
        image_size=experiment.data.image_size,
        shifts=options.shift,
        cameras=experiment.data.cameras,
    )
    on_device, act = options.loop == "device", withholding(policy.act, check_parts(options.withhold))
    return run_task(
        environment,
        DeviceLoop(environment, policy) if on_device else on_host(environment, act),
        episodes,
        split="eval",
        seed=options.seed,
        batch=options.batch,
        keypoint_noise=options.keypoint_noise,
        find_keypoints=keypoint_source(options.keypoints or experiment.keypoints, environment),
        label=f"{name} ({options.physics})",
    )


def strip_file(folder: Path, task: str, episode: int) -> Path:
    """Where the film strip of an episode is."""
    return folder / f"{task}-{episode}.png"


def save_strips(folder: Path, task: str, outcomes: Sequence[EpisodeOutcome]) -> None:
    """Writes the film strip of every episode, each target marked in the frame it was answered to."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, outcome in enumerate(outcomes):
        *seen, last = outcome.views
        # The loop on the device keeps the last view alone.
        marked = [mark_view(v.rgb, t, v.camera) for v, t in zip(seen, outcome.targets, strict=bool(seen))]
        write_picture(strip_file(folder, task, i), film_strip([*marked, mark_view(last.rgb, None, last.camera)]))


def load_strips(folder: Path, results: Sequence[EpisodeResult]) -> dict[tuple[str, int], list[np.ndarray]]:
    """The film strips of the results that have one, as `write_report` takes them."""
    paths = {(r.task, r.episode): strip_file(folder, r.task, r.episode) for r in results}
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
