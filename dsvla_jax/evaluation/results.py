"""Results of closed-loop episodes: one line of JSON an episode, with the conditions it was run under."""

import dataclasses
import json
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.conditions import Conditions, conditions_from_json
from dsvla_jax.evaluation.statistics import Pairs, count_pairs, wilson_interval
from dsvla_jax.files import replacing

FILE = "results.jsonl"


@dataclasses.dataclass(frozen=True)
class EpisodeResult:
    """What became of one episode. Every field is plain JSON."""

    task: str
    episode: int
    """Its number in the stream of the task's episodes: the same start under both kinds of physics."""
    success: bool
    reason: str
    """Why it failed; empty on success."""
    keyframes: int
    """Keyframes executed."""
    instruction: str
    answers: list[str]
    """The policy's answer text for each keyframe."""
    conditions: Conditions

    @property
    def key(self) -> tuple[str, int, Conditions]:
        """What names an episode: a later result of the same key replaces an earlier one."""
        return self.task, self.episode, self.conditions


@dataclasses.dataclass(frozen=True)
class SuccessRate:
    """Successes of a task (or of all episodes) with the ends of the 95 % Wilson interval."""

    name: str
    successes: int
    trials: int

    @property
    def rate(self) -> float:
        """Share of successes; NaN without trials."""
        return self.successes / self.trials if self.trials else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """The ends of the 95 % Wilson interval."""
        return wilson_interval(self.successes, self.trials)


def write_results(folder: Path, results: Iterable[EpisodeResult]) -> None:
    """Writes results.jsonl, one line an episode. The file appears whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [json.dumps(dataclasses.asdict(result), ensure_ascii=False) + "\n" for result in results]
    with replacing(folder / FILE) as partial:
        partial.write_text("".join(lines), encoding="utf-8")


def read_results(folder: Path) -> list[EpisodeResult]:
    """Reads all results of a folder, the earliest first; none if it holds none.

    Files of versions that kept each kind of conditions in a file of its own are read too. Raises UserError if a line is
    damaged.
    """
    files = sorted(folder.glob("*.jsonl"), key=lambda file: (file.name == FILE, file.name))
    return merge_results([], [result for file in files for result in _read_file(file)])


def _read_file(file: Path) -> list[EpisodeResult]:
    results = []
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            fields = json.loads(line)
            conditions = dict(fields.pop("conditions", {}))
            # Names of earlier versions.
            if "physics" in fields:
                conditions["physics"] = fields.pop("physics")
            for old, new in (("seed", "episode"), ("actions", "answers")):
                if old in fields:
                    fields[new] = fields.pop(old)
            results.append(EpisodeResult(**fields, conditions=conditions_from_json(conditions)))
        except (json.JSONDecodeError, TypeError, ValueError, AttributeError) as error:
            raise UserError(
                f"{file}, line {number}: not an episode result ({error}); delete that line, and evaluate its task again"
            ) from error
    return results


def merge_results(earlier: Sequence[EpisodeResult], fresh: Sequence[EpisodeResult]) -> list[EpisodeResult]:
    """Adds fresh results to earlier ones. Of the same episode under the same conditions the later stays, at the end."""
    merged = {result.key: result for result in earlier}
    for result in fresh:
        merged.pop(result.key, None)
        merged[result.key] = result
    return list(merged.values())


def latest(results: Sequence[EpisodeResult], matches: Callable[[Conditions], bool]) -> list[EpisodeResult]:
    """Of each task, the results under those of the matching conditions that were added last."""
    chosen = {result.task: result.conditions for result in results if matches(result.conditions)}
    kept = [result for result in results if chosen.get(result.task) == result.conditions]
    order = {task: place for place, task in enumerate(chosen)}
    return sorted(kept, key=lambda result: (order[result.task], result.episode))


def finished_tasks(results: Sequence[EpisodeResult], conditions: Conditions, episodes: int) -> set[str]:
    """The tasks of which the first `episodes` episodes have results under these conditions."""
    measured = {(result.task, result.episode) for result in results if result.conditions == conditions}
    return {task for task, _ in measured if all((task, number) in measured for number in range(episodes))}


def checkpoints_of(results: Sequence[EpisodeResult]) -> str:
    """The step that the results are of, or which tasks are of which, for people; empty if none is known."""
    tasks: dict[tuple[int | None, str], dict[str, None]] = {}
    for result in results:
        tasks.setdefault((result.conditions.step, result.conditions.digest), {})[result.task] = None
    if len(tasks) < 2:
        return "".join(f"step {step}" for step, _ in tasks if step is not None)
    return "; ".join(f"step {'unknown' if s is None else s}: {', '.join(names)}" for (s, _), names in tasks.items())


def success_rates(results: Sequence[EpisodeResult]) -> list[SuccessRate]:
    """One rate a task, in the order in which the tasks first appear."""
    counts: dict[str, list[int]] = {}
    for result in results:
        successes_trials = counts.setdefault(result.task, [0, 0])
        successes_trials[0] += result.success
        successes_trials[1] += 1
    return [SuccessRate(task, *numbers) for task, numbers in counts.items()]


def macro_mean(rates: Sequence[SuccessRate]) -> float:
    """The mean of the tasks' rates: every task counts the same, however many episodes it had."""
    return float(np.mean([rate.rate for rate in rates])) if rates else float("nan")


def paired(first: Sequence[EpisodeResult], second: Sequence[EpisodeResult]) -> Pairs:
    """Counts outcomes of the episodes that both runs have; episodes of the same task and number start alike."""
    one, other = ({(result.task, result.episode): result.success for result in results} for results in (first, second))
    both = [episode for episode in one if episode in other]
    return count_pairs([one[episode] for episode in both], [other[episode] for episode in both])


def pooled(rates: Sequence[SuccessRate]) -> SuccessRate:
    """All episodes as if they were of one task."""
    return SuccessRate("all episodes", sum(rate.successes for rate in rates), sum(rate.trials for rate in rates))


@dataclasses.dataclass(frozen=True)
class TaskComparison:
    """A task under two conditions, on the episodes that both have."""

    task: str
    first: SuccessRate
    second: SuccessRate
    only_first: int
    """Episodes that only the first succeeded in."""
    only_second: int


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Two result sets on the episodes that both have."""

    names: tuple[str, str]
    tasks: list[TaskComparison]
    differing: list[tuple[EpisodeResult, EpisodeResult]]
    """Pairs of results of the episodes with unlike outcomes."""


def compare_physics(first: Sequence[EpisodeResult], second: Sequence[EpisodeResult]) -> Comparison:
    """Pairs the episodes of two sets by task, number and checkpoint."""

    def key(result: EpisodeResult) -> tuple[str, int, str]:
        return result.task, result.episode, result.conditions.digest

    partner = {key(result): result for result in second}
    pairs = [(result, partner[key(result)]) for result in first if key(result) in partner]
    tasks = []
    for task in dict.fromkeys(one.task for one, _ in pairs):
        outcomes = [(one.success, two.success) for one, two in pairs if one.task == task]
        one, two = (SuccessRate(task, sum(column), len(outcomes)) for column in zip(*outcomes, strict=True))
        only_first, only_second = outcomes.count((True, False)), outcomes.count((False, True))
        tasks.append(TaskComparison(task, one, two, only_first, only_second))
    names = tuple(", ".join(dict.fromkeys(result.conditions.physics for result in side)) for side in (first, second))
    return Comparison((names[0], names[1]), tasks, [(a, b) for a, b in pairs if a.success != b.success])


def require_writable(folder: Path) -> None:
    """Makes a folder if it is missing. Raises UserError if results could not be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(2**16))
    except OSError as error:
        raise UserError(f"{folder}: cannot write here ({error.strerror}); choose another place with --out") from error
