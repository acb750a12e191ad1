"""Evaluate a run in closed loop: python eval.py RUN [--physics mjx] [--tasks lamp_on ...] [--episodes 25]

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

import jax
import numpy as np
import tyro
from tqdm import tqdm

from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.encoding.keypoints import active_keypoint, advance_latch
from dsvla_jax.errors import UserError
from dsvla_jax.policy import Policy, load_policy
from dsvla_jax.report import EpisodeResult, mark_targets, print_table, read_results, write_report, write_results
from dsvla_jax.sim.episode import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import get_task
from dsvla_jax.training.experiment import Experiment, load_experiment


@dataclasses.dataclass(frozen=True)
class Options:
    """Closed-loop evaluation of a trained run."""

    run: tyro.conf.Positional[Path]
    """The run folder that train.py wrote."""
    physics: Literal["mujoco", "mjx"] = "mujoco"
    """C MuJoCo on the processor, or vectorised MJX on whatever device JAX has."""
    tasks: tuple[str, ...] = ()
    """Which tasks; those the run was trained on if not given."""
    episodes: int | None = None
    """Unseen episodes a task; the config's number if not given."""
    keypoint_noise: float = 0.0
    """Metres of uniform noise an axis on every keypoint (paper, section 4.3: up to 0.1)."""
    seed: int = 0
    skip_finished: bool = False
    """Leave a finished evaluation of this checkpoint as it is."""


def main(options: Options) -> None:
    """Evaluates, prints the table, writes results and report."""
    if not (options.run / "config.json").exists():
        raise UserError(f"{options.run}: no run here (config.json is missing); train one: python train.py CONFIG")
    experiment = load_experiment(options.run / "config.json")
    tasks = options.tasks or experiment.data.tasks
    for name in tasks:
        get_task(name)
    episodes = options.episodes or experiment.evaluation.episodes
    folder = options.run / "eval"
    noise = f"-keypoint-noise-{options.keypoint_noise:g}" if options.keypoint_noise else ""
    file = folder / f"{options.physics}{noise}.jsonl"
    if options.skip_finished and is_finished(file, options.run, tasks, episodes):
        print(f"{file} is newer than the training and complete: nothing to do")
        print_table(read_results(file))
        return

    policy = load_policy(options.run)
    results: list[EpisodeResult] = []
    strips: dict[tuple[str, int], list[np.ndarray]] = {}
    for name in tasks:
        outcome, films = evaluate_task(policy, experiment, name, episodes, options)
        results += outcome
        strips |= {(name, result.seed): film for result, film in zip(outcome, films, strict=True)}
    write_results(file, results)
    other = folder / f"{'mjx' if options.physics == 'mujoco' else 'mujoco'}{noise}.jsonl"
    report = file.with_suffix(".html")
    write_report(report, results, strips, read_results(other) if other.exists() else None, title=str(options.run))
    print_table(results)
    print(f"report: {report}")


def is_finished(file: Path, run: Path, tasks: Sequence[str], episodes: int) -> bool:
    """Whether the file holds all these episodes, evaluated after the last training."""
    if not file.exists() or file.stat().st_mtime < (run / "metrics.jsonl").stat().st_mtime:
        return False
    done = Counter(result.task for result in read_results(file))
    return all(done[task] >= episodes for task in tasks)


def evaluate_task(
    policy: Policy, experiment: Experiment, name: str, episodes: int, options: Options
) -> tuple[list[EpisodeResult], list[list[np.ndarray]]]:
    """All episodes of one task side by side. Returns their results and the frames that the policy saw."""
    task = get_task(name)
    environment = Environment(task, physics=options.physics, image_size=experiment.data.image_size)
    keys = episode_keys(options.seed, "eval", name, 0, episodes)
    limit = experiment.evaluation.max_keyframes
    with tqdm(total=limit, desc=f"{name} x {episodes} ({options.physics})", unit="keyframe") as bar:
        bar.set_postfix_str("resetting; the first use compiles")
        state = environment.reset(keys)
        instructions = environment.instructions(state, np.arange(episodes))
        keypoints = np.asarray(environment.keypoints(state))
        noise = np.random.default_rng(options.seed).uniform(-1, 1, keypoints.shape) * options.keypoint_noise
        keypoints = (keypoints + noise).astype(np.float32)
        latched = np.zeros(keypoints.shape[:2], np.int32)
        success = np.asarray(environment.success(state))
        frames: list[list[np.ndarray]] = [[] for _ in range(episodes)]
        actions: list[list[str]] = [[] for _ in range(episodes)]
        used = np.zeros(episodes, int)
        unreachable = np.zeros(episodes, bool)
        for _ in range(limit):
            observation = environment.observe(state)
            latched = np.asarray(jax.vmap(advance_latch)(latched, observation.pose[..., :3], keypoints))
            active = np.asarray(jax.vmap(jax.vmap(active_keypoint))(latched, keypoints))
            action, answers = policy.act(observation, instructions, active)
            rgb, targets = np.asarray(observation.rgb), np.asarray(action.pose)[..., :3]
            for i in np.flatnonzero(~success):
                frames[i].append(mark_targets(rgb[i], targets[i], environment.camera))
                actions[i].append(answers[i])
            used += ~success
            state = environment.execute(state, action)
            unreachable |= np.asarray(state.ik_failed) & ~success
            success = np.asarray(environment.success(state))
            bar.update()
            bar.set_postfix_str(f"{success.sum()}/{episodes} succeeded")
            if success.all():
                break
        last = np.asarray(environment.observe(state).rgb)
        diverged = np.asarray(state.diverged)
    results = []
    for i in range(episodes):
        frames[i].append(last[i])
        reason = "" if success[i] else failure_reason(bool(diverged[i]), bool(unreachable[i]))
        results.append(
            EpisodeResult(name, i, options.physics, bool(success[i]), reason, int(used[i]), instructions[i], actions[i])
        )
    return results, frames


def failure_reason(diverged: bool, unreachable: bool) -> str:
    """Why an episode without success failed, the gravest reason first."""
    if diverged:
        return "the simulation diverged"
    return "a pose was out of reach" if unreachable else "out of keyframes"


if __name__ == "__main__":
    with fail_with_message():
        parsed = tyro.cli(Options, prog="eval.py", description=__doc__)
        configure_jax()
        started = time.monotonic()
        main(parsed)
        print(f"{time.monotonic() - started:.0f} s", file=sys.stderr)
