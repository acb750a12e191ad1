"""Results of closed-loop episodes: JSON lines, a table for the terminal, and one self-contained HTML page."""

import base64
import dataclasses
import json
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import jinja2
import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.statistics import wilson_interval
from dsvla_jax.files import replacing
from dsvla_jax.geometry.cameras import project
from dsvla_jax.types import Camera

MAX_STRIP_FRAMES = 10
_GAP = 2  # pixels between the frames of a strip
_ARM_COLOURS = ((255, 0, 200), (0, 220, 255))  # RGB, the left arm first; no task has an object of these colours


@dataclasses.dataclass(frozen=True)
class EpisodeResult:
    """What became of one episode. Every field is plain JSON.

    seed: with ``task`` it names the episode: the same start under both kinds of physics. physics: "mujoco" or "mjx".
    reason: why it failed; empty on success. keyframes: key poses executed. actions: one entry a key pose, the text
    that the policy answered. conditions: what else the outcome depends on, above all `step` and `digest` of the
    checkpoint; empty in files of earlier versions.
    """

    task: str
    seed: int
    physics: str
    success: bool
    reason: str
    keyframes: int
    instruction: str
    actions: list[Any]
    conditions: dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class SuccessRate:
    """Successes of a task (or of all episodes) with the ends of the 95 % Wilson interval."""

    name: str
    successes: int
    trials: int

    @property
    def rate(self) -> float:
        return self.successes / self.trials if self.trials else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        return wilson_interval(self.successes, self.trials)


def write_results(path: str | os.PathLike, results: Iterable[EpisodeResult]) -> None:
    """One line of JSON an episode. The file appears whole or not at all."""
    lines = [json.dumps(dataclasses.asdict(result), ensure_ascii=False) + "\n" for result in results]
    write_whole(Path(path), "".join(lines))


def read_results(path: str | os.PathLike) -> list[EpisodeResult]:
    """The episodes of a file that `write_results` wrote. Raises UserError where there is none or it is damaged."""
    if not Path(path).exists():
        raise UserError(f"{path}: no results here; evaluate first: python eval.py RUN, under the same conditions")
    results = []
    for number, line in enumerate(Path(path).read_text(encoding="utf-8").splitlines(), start=1):
        try:
            results.append(EpisodeResult(**json.loads(line)))
        except (json.JSONDecodeError, TypeError) as error:
            raise UserError(
                f"{path}, line {number}: not an episode result ({error}); delete the file and evaluate again"
            ) from error
    return results


def merge_results(
    earlier: Sequence[EpisodeResult], fresh: Sequence[EpisodeResult]
) -> tuple[list[EpisodeResult], list[EpisodeResult]]:
    """The earlier results with the fresh ones put in, and what they displace: by task, then by seed.

    Tasks without fresh results stay as they are. Of the others, results under the same conditions stay unless their
    episode was run again; those under other conditions are displaced. Fresh results of one task share conditions.
    """
    conditions = {result.task: result.conditions for result in fresh}
    again = {(result.task, result.seed) for result in fresh}
    displaced = [r for r in earlier if r.task in conditions and r.conditions != conditions[r.task]]
    kept = [r for r in earlier if conditions.get(r.task, r.conditions) == r.conditions]
    order = {task: place for place, task in enumerate(dict.fromkeys(r.task for r in (*earlier, *fresh)))}
    merged = [*fresh, *(r for r in kept if (r.task, r.seed) not in again)]
    return sorted(merged, key=lambda result: (order[result.task], result.seed)), displaced


def checkpoints_of(results: Sequence[EpisodeResult]) -> str:
    """For people: the step that the results are of, or which tasks are of which; empty if none is known."""
    tasks: dict[tuple[Any, Any], dict[str, None]] = {}
    for result in results:
        key = (result.conditions.get("step"), result.conditions.get("digest"))
        tasks.setdefault(key, {})[result.task] = None
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


def pooled(rates: Sequence[SuccessRate]) -> SuccessRate:
    """All episodes as if they were of one task."""
    return SuccessRate("all episodes", sum(rate.successes for rate in rates), sum(rate.trials for rate in rates))


def print_table(results: Sequence[EpisodeResult], console: Console | None = None) -> None:
    """Success rates on the terminal."""
    rates = success_rates(results)
    physics = ", ".join(dict.fromkeys(result.physics for result in results))
    measured = ", ".join(part for part in (physics or "no episodes", checkpoints_of(results)) if part)
    table = Table(title=f"closed-loop success ({measured})")
    # Names are told apart by their ends, which would otherwise be cut off.
    table.add_column("task", overflow="fold")
    for column in ("successes", "rate %", "95 % interval"):
        table.add_column(column, justify="right")
    for rate in rates:
        table.add_row(*_cells(rate))
    table.add_section()
    table.add_row(*_cells(pooled(rates)))
    table.add_row("mean of tasks", "", f"{100 * macro_mean(rates):.1f}", "")
    (console or Console()).print(table)


def print_comparison(sets: Mapping[str, Sequence[EpisodeResult]], console: Console | None = None) -> None:
    """Success rates of several runs side by side, a row a task that any of them has; results by the run's name."""
    rates = {name: {rate.name: rate for rate in success_rates(results)} for name, results in sets.items()}
    table = Table(title="closed-loop success, % (95 % interval)")
    table.add_column("task", overflow="fold")
    for name, results in sets.items():
        checkpoints = checkpoints_of(results)
        heading = f"{name}\n{checkpoints}" if checkpoints else name
        table.add_column(Text(heading), justify="right", overflow="fold")
    for task in dict.fromkeys(task for of_run in rates.values() for task in of_run):
        cells = [_rate_cell(of_run.get(task)) for of_run in rates.values()]
        table.add_row(task, *cells)
    table.add_section()
    common = set.intersection(*(set(of_run) for of_run in rates.values()))
    means = [100 * macro_mean([rate for task, rate in of_run.items() if task in common]) for of_run in rates.values()]
    table.add_row(f"mean of the {len(common)} tasks that all have", *(f"{mean:.1f}" for mean in means))
    (console or Console()).print(table)


def _rate_cell(rate: SuccessRate | None) -> str:
    if rate is None:
        return "-"
    low, high = rate.interval
    return f"{100 * rate.rate:.1f} ({100 * low:.0f} to {100 * high:.0f})"


def _cells(rate: SuccessRate) -> tuple[str, str, str, str]:
    low, high = rate.interval
    return (
        rate.name,
        f"{rate.successes}/{rate.trials}",
        f"{100 * rate.rate:.1f}",
        f"{100 * low:.1f} to {100 * high:.1f}",
    )


def mark_targets(frame: np.ndarray, positions, camera: Camera) -> np.ndarray:
    """A copy of the frame with a ring where each arm's target is: magenta the left or only arm, cyan the right one.

    frame: uint8 (H, W, 3), RGB. positions: float (A, 3), metres, world frame. A target outside the picture is a dot at
    the nearest border; one behind the camera is left out.
    """
    picture = np.ascontiguousarray(frame).copy()
    height, width = picture.shape[:2]
    pixels, depth = project(jnp.asarray(positions, jnp.float32), camera)
    radius = max(3.0, height / 24)
    fraction = 4  # sub-pixel bits of cv2's fixed-point coordinates
    for (u, v), z, colour in zip(np.asarray(pixels), np.asarray(depth), _ARM_COLOURS, strict=False):
        if z <= 0:
            continue
        inside = 0 <= u <= width - 1 and 0 <= v <= height - 1
        size = radius if inside else 0.5 * radius
        place = np.clip([u, v], size, [width - 1 - size, height - 1 - size]) if not inside else np.array([u, v])
        centre = tuple(round(float(c) * 2**fraction) for c in place)
        for shade, thickness in (((0, 0, 0), 2), (colour, 1)) if inside else (((0, 0, 0), 2), (colour, -1)):
            cv2.circle(picture, centre, int(size * 2**fraction), shade, thickness, cv2.LINE_AA, fraction)
        if inside:
            cv2.circle(picture, centre, int(0.15 * radius * 2**fraction), colour, -1, cv2.LINE_AA, fraction)
    return picture


def film_strip(frames: Sequence[np.ndarray], max_frames: int = MAX_STRIP_FRAMES) -> np.ndarray:
    """Frames uint8 (H, W, 3) side by side; of more than ``max_frames`` an even choice with the first and the last."""
    if not len(frames):
        raise ValueError("a film strip needs at least one frame")
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), max_frames)).round().astype(int))
    gap = np.full((frames[0].shape[0], _GAP, 3), 255, np.uint8)
    pieces = [piece for index in chosen for piece in (frames[index], gap)]
    return np.concatenate(pieces[:-1], axis=1)


def write_report(
    path: str | os.PathLike,
    results: Sequence[EpisodeResult],
    strips: Mapping[tuple[str, int], Sequence[np.ndarray]] | None = None,
    other: Sequence[EpisodeResult] | None = None,
    title: str = "Closed-loop evaluation",
) -> None:
    """The HTML report: rates with intervals, a row an episode with its film strip, and where physics differ.

    strips: RGB frames uint8 (H, W, 3) by (task, seed); see `mark_targets`. other: results under the other kind of
    physics, compared where they are of the same episodes and checkpoint. The page needs no other file and no network.
    """
    rates = success_rates(results)
    write_html(
        Path(path),
        Path(__file__).with_name("report.html.jinja"),
        title=title,
        physics=", ".join(dict.fromkeys(result.physics for result in results)),
        rates=rates,
        pooled=pooled(rates),
        macro=macro_mean(rates),
        episodes={rate.name: [result for result in results if result.task == rate.name] for rate in rates},
        pictures={key: png_data(film_strip(frames)) for key, frames in (strips or {}).items() if len(frames)},
        comparison=compare_physics(results, other) if other else None,
        checkpoints=checkpoints_of(results),
    )


def write_html(file: Path, template: Path, **values: Any) -> None:
    """Fills in a template; the page appears whole, and needs no other file and no network.

    Its filters: `percent` of a share, and `picture` of uint8 (H, W, 3), which goes into an `img`.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template.parent), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"percent": lambda value: f"{100 * value:.1f}", "picture": png_data}
    write_whole(file, environment.get_template(template.name).render(**values))


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Two result sets on the episodes that both have.

    tasks: (name, rate of the first, of the second, episodes only the first succeeded in, only the second) each.
    differing: pairs of results of the episodes with unlike outcomes.
    """

    names: tuple[str, str]
    tasks: list[tuple[str, SuccessRate, SuccessRate, int, int]]
    differing: list[tuple[EpisodeResult, EpisodeResult]]


def compare_physics(first: Sequence[EpisodeResult], second: Sequence[EpisodeResult]) -> Comparison:
    """Pairs the episodes of two sets by task, seed and checkpoint."""

    def key(result: EpisodeResult) -> tuple[Any, ...]:
        return result.task, result.seed, result.conditions.get("digest")

    partner = {key(result): result for result in second}
    pairs = [(result, partner[key(result)]) for result in first if key(result) in partner]
    tasks = []
    for task in dict.fromkeys(one.task for one, _ in pairs):
        outcomes = [(one.success, two.success) for one, two in pairs if one.task == task]
        rates = [SuccessRate(task, sum(column), len(outcomes)) for column in zip(*outcomes, strict=True)]
        tasks.append((task, rates[0], rates[1], outcomes.count((True, False)), outcomes.count((False, True))))
    names = tuple(", ".join(dict.fromkeys(result.physics for result in side)) for side in (first, second))
    return Comparison((names[0], names[1]), tasks, [(a, b) for a, b in pairs if a.success != b.success])


def png_data(rgb: np.ndarray) -> str:
    """uint8 (H, W, 3), RGB, as a data URI for a page."""
    encoded, data = cv2.imencode(".png", rgb[..., ::-1])
    if not encoded:
        raise ValueError(f"cannot encode an image of shape {rgb.shape} and type {rgb.dtype} as PNG")
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode()


def write_whole(path: Path, text: str) -> None:
    """Writes a file that appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def require_writable(folder: Path) -> None:
    """Makes a folder if it is missing. Raises UserError if results could not be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(2**16))
    except OSError as error:
        raise UserError(f"{folder}: cannot write here ({error.strerror}); choose another place with --out") from error
