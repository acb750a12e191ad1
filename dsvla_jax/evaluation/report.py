"""Success rates for people: tables for the terminal, and one self-contained HTML page."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from dsvla_jax.evaluation.pages import png_data, write_html
from dsvla_jax.evaluation.pictures import film_strip
from dsvla_jax.evaluation.results import (
    EpisodeResult,
    SuccessRate,
    checkpoints_of,
    compare_physics,
    macro_mean,
    paired,
    pooled,
    success_rates,
)
from dsvla_jax.evaluation.seeing import KeyframeErrors, name_of
from dsvla_jax.evaluation.statistics import Pairs, paired_interval, sign_test


def print_table(results: Sequence[EpisodeResult], console: Console | None = None) -> None:
    """Success rates on the terminal."""
    rates = success_rates(results)
    measured = ", ".join(part for part in (describe(results), checkpoints_of(results)) if part)
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
    """Success rates of several runs side by side, a row a task that any of them has; results by the run's name.

    The last rows compare each other run with the first one over the episodes that both have.
    """
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
    table.add_row(*_means([list(of_run.values()) for of_run in rates.values()]))
    first, *others = sets.values()
    pairs = [paired(results, first) for results in others]
    table.add_row("difference from the first run, same episodes", "", *map(_difference_cell, pairs))
    table.add_row("p-value (McNemar's exact test)", "", *(f"{sign_test(one):.2g}" for one in pairs))
    (console or Console()).print(table)


def _means(sets: Sequence[Sequence[SuccessRate]]) -> list[str]:
    """The mean of the tasks that all sets have: its name, then a cell a set."""
    common = set.intersection(*({rate.name for rate in rates} for rates in sets))
    tasks = "task" if len(common) == 1 else f"{len(common)} tasks"
    means = [100 * macro_mean([rate for rate in rates if rate.name in common]) for rates in sets]
    return [f"mean of the {tasks} that all have", *(f"{mean:.1f}" for mean in means)]


def _rate_cell(rate: SuccessRate | None) -> str:
    if rate is None:
        return "-"
    low, high = rate.interval
    return f"{100 * rate.rate:.1f} ({100 * low:.0f} to {100 * high:.0f})"


def _difference_cell(pairs: Pairs) -> str:
    low, high = paired_interval(pairs)
    return f"{100 * pairs.difference:+.1f} ({100 * low:+.0f} to {100 * high:+.0f})" if pairs.trials else "-"


def _cells(rate: SuccessRate) -> tuple[str, str, str, str]:
    low, high = rate.interval
    return (
        rate.name,
        f"{rate.successes}/{rate.trials}",
        f"{100 * rate.rate:.1f}",
        f"{100 * low:.1f} to {100 * high:.1f}",
    )


def write_report(
    path: Path,
    results: Sequence[EpisodeResult],
    strips: Mapping[tuple[str, int], Sequence[np.ndarray]] | None = None,
    other: Sequence[EpisodeResult] | None = None,
    withheld: Sequence[Sequence[EpisodeResult]] = (),
    errors: Sequence[KeyframeErrors] = (),
    title: str = "Closed-loop evaluation",
) -> None:
    """The HTML report: rates with intervals, a row an episode with its film strip, and where physics differ.

    strips: RGB frames uint8 (H, W, 3) by task and episode; see `mark_targets`. other: results under the other kind of
    physics, compared where they are of the same episodes and checkpoint. withheld: results of the same checkpoint
    with other parts of its observations withheld, and errors: its errors on held-out demonstrations. The page needs no
    other file and no network.
    """
    rates = success_rates(results)
    write_html(
        path,
        Path(__file__).with_name("report.html.jinja"),
        title=title,
        conditions=describe(results),
        rates=rates,
        pooled=pooled(rates),
        macro=macro_mean(rates),
        episodes={rate.name: [result for result in results if result.task == rate.name] for rate in rates},
        pictures={key: png_data(film_strip(frames)) for key, frames in (strips or {}).items() if len(frames)},
        comparison=compare_physics(results, other) if other else None,
        checkpoints=checkpoints_of(results),
        seen=Seen.of([results, *withheld], errors),
    )


@dataclasses.dataclass(frozen=True)
class Seen:
    """What a policy owes to what it sees, as tables: what is withheld heads the columns.

    success: a row a task, and the mean. errors: a row a task and keyframe.
    """

    success_columns: list[str]
    success: list[tuple[str, list[str]]]
    error_columns: list[str]
    errors: list[tuple[str, list[str]]]

    @classmethod
    def of(cls, results: Sequence[Sequence[EpisodeResult]], errors: Sequence[KeyframeErrors]) -> "Seen":
        """results: of one kind of conditions each."""
        results = sorted((some for some in results if some), key=lambda some: some[0].conditions.withheld)
        success: list[tuple[str, list[str]]] = []
        if len(results) > 1:
            rates = [success_rates(some) for some in results]
            by_task = [{rate.name: f"{100 * rate.rate:.0f}" for rate in some} for some in rates]
            tasks = dict.fromkeys(task for some in by_task for task in some)
            success = [(task, [some.get(task, "") for some in by_task]) for task in tasks]
            name, *means = _means(rates)
            success.append((name, means))
        views = list(dict.fromkeys(one.withheld for one in errors))
        cells = {(one.task, one.keyframe, one.withheld): one.describe() for one in errors}
        return cls(
            success_columns=[name_of(some[0].conditions.withheld) for some in results],
            success=success,
            error_columns=[name_of(parts) for parts in views],
            errors=[
                (f"{task}, {keyframe}", [cells.get((task, keyframe, view), "") for view in views])
                for task, keyframe in dict.fromkeys((one.task, one.keyframe) for one in errors)
            ],
        )


def describe(results: Sequence[EpisodeResult]) -> str:
    """The conditions that the results were made under, for people."""
    return "; ".join(dict.fromkeys(result.conditions.describe() for result in results)) or "no episodes"
