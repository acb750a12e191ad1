"""Every field of every config with zero, negative, huge and contradicting values: refused, or two steps (30 minutes).

Usage: python -m benchmarks.odd_settings [--only model.vision --folder DIR]

Each value must end in one message without a run folder, or in two steps of training. What settings and shapes show is
asked of each value alone. Those that pass are trained together, as many fields at a time as suit one another, in a
process whose memory is limited; a group that fails is halved until the value is found.
"""

import collections
import contextlib
import dataclasses
import functools
import io
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import threading
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import tyro
from tqdm import tqdm

import train
from data_pipelines.oxe.fixtures.write import write_fixture
from data_pipelines.preparation import prepare
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment
from dsvla_jax.planner.preflight import check_step
from dsvla_jax.suite_vocabulary import suite_tokenizer
from dsvla_jax.training.distributed import Watchdog
from tests.odd_settings import OddSetting, baseline_experiments, odd_settings, toy_experiment

DATASET = "utokyo_xarm_bimanual_converted_externally_to_rlds"
# Nothing of the toy size needs more; a value that does must be refused before it is allocated.
MEMORY = 12 * 2**30
SECONDS = 900
# A run of more steps is asked to stop once it has done two.
LONG = 100
# What the traced network does not depend on.
NOT_TRACED = ("data.", "oxe.", "optimizer.", "validation.", "evaluation.")

LARGE = 10**6

REFUSED, TRAINED = "refused with a message", "trained two steps"
Group = tuple[OddSetting, ...]


@dataclasses.dataclass(frozen=True)
class Options:
    """Which values."""

    only: str = ""
    """Fields whose names begin so; all if empty."""
    folder: Path | None = None
    """Where runs go; a temporary folder if not given."""


def oxe_experiment(toy: Experiment, folder: Path) -> Experiment:
    """The toy experiment on a small Open X-Embodiment dataset."""
    write_fixture(folder / "oxe", DATASET, episodes=9, steps=9)
    oxe = OxeConfig(folder=str(folder / "oxe"), mixture=(DATASET,), image_size=32, streams=2, window=4)
    language = dataclasses.replace(toy.model.language, vocab_size=suite_tokenizer().vocab_size)
    return dataclasses.replace(
        toy,
        oxe=oxe,
        tokenizer="",
        model=dataclasses.replace(toy.model, language=language),
        encoding=dataclasses.replace(toy.encoding, use_points=False, use_keypoints=False),
        validate_every=0,
    )


def with_all(experiment: Experiment, group: Group) -> Experiment:
    """The experiment with all values of a group."""
    return functools.reduce(lambda one, odd: odd.apply(one), group, experiment)


def from_settings(experiment: Experiment, group: Group, run: Path, traced: bool) -> str:
    """What becomes of values before anything is written; empty if they pass. traced: whether shapes are asked too."""
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            prepared = prepare(with_all(experiment, group), run)
            if traced:
                check_step(prepared.experiment, prepared.mesh, prepared.picture)
    except UserError:
        return REFUSED
    except Exception:
        return traceback.format_exc(limit=-3)
    return ""


def from_training(experiment: Experiment, group: Group, run: Path) -> str:
    """What becomes of values in a run of two steps."""
    changed = with_all(experiment, group)
    if changed.steps > LONG:
        threading.Thread(target=_stop_after_two_steps, args=(run,), daemon=True).start()
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            train.main(changed, run, Watchdog(run / "processes"))
    except UserError as error:
        return f"a run folder, and {error}" if run.exists() else REFUSED
    except Exception:
        return traceback.format_exc(limit=-3)
    return TRAINED if any((run / "checkpoints").glob("[2-9]*")) else "no two steps"


def _stop_after_two_steps(run: Path) -> None:
    metrics = run / "metrics.jsonl"
    while not metrics.exists() or metrics.read_text().count('"step"') < 2:
        time.sleep(0.1)
    os.kill(os.getpid(), signal.SIGTERM)


def start_worker() -> None:
    """Limits the memory of this process, and lets it compile nothing twice."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    configure_jax()


def groups_of(experiment: Experiment, odds: list[OddSetting], run: Path) -> list[Group]:
    """The values in few groups: each field once in a group, and no two that contradict each other.

    Values that take much memory are alone: together they would be refused, and one after the other found again.
    """
    large = [odd for odd in odds if odd.value in (LARGE, (LARGE,))]
    groups: list[Group] = []
    for odd in (odd for odd in odds if odd not in large):
        for place, group in enumerate(groups):
            alone = odd.name not in {other.name for other in group}
            if alone and not from_settings(experiment, (*group, odd), run, traced=False):
                groups[place] = (*group, odd)
                break
        else:
            groups.append((odd,))
    return groups + [(odd,) for odd in large]


def train_group(experiment: Experiment, group: Group, folder: Path, bar: tqdm) -> dict[OddSetting, str]:
    """What becomes of each value of a group."""
    run = Path(tempfile.mkdtemp(dir=folder)) / "run"
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), start_worker) as pool:
        future = pool.submit(from_training, experiment, group, run)
        try:
            outcome = future.result(SECONDS)
        except Exception as error:
            outcome = f"the process ended: {error!r}"
            for process in multiprocessing.active_children():
                process.kill()
    if outcome == TRAINED or len(group) == 1:
        bar.update(len(group))
        return dict.fromkeys(group, outcome)
    tqdm.write(f"of {len(group)} values from {group[0].name} on, one does not train: {outcome.splitlines()[-1]}")
    middle = len(group) // 2
    return train_group(experiment, group[:middle], folder, bar) | train_group(experiment, group[middle:], folder, bar)


def outcomes_of(experiment: Experiment, odds: list[OddSetting], folder: Path) -> dict[OddSetting, str]:
    """What becomes of each value."""
    run = folder / "run"
    traced = [not odd.name.startswith(NOT_TRACED) for odd in odds]
    bar = tqdm(list(zip(odds, traced, strict=True)), desc="settings and shapes", unit="value")
    alone = {odd: from_settings(experiment, (odd,), run, deep) for odd, deep in bar}
    if run.exists():
        raise UserError(f"{run}: nothing should have been written")
    passed = [odd for odd, outcome in alone.items() if not outcome]
    with tqdm(total=len(passed), desc="training", unit="value") as bar:
        for group in groups_of(experiment, passed, run):
            alone |= train_group(experiment, group, folder, bar)
    return alone


def main(options: Options, folder: Path) -> int:
    """Prints the figures, and each value that is neither refused nor trained. Returns the exit status."""
    toy, outcomes = toy_experiment(folder), {}
    experiments = [(toy, ""), (oxe_experiment(toy, folder), "oxe.")]
    experiments += [(experiment, "baseline.") for experiment in baseline_experiments(toy)]
    for experiment, section in experiments:
        # Of all but the first experiment only what that does not have.
        odds = [odd for odd in odd_settings(experiment) if odd.name.startswith(section)]
        chosen = [odd for odd in odds if odd.name.startswith(options.only)]
        told = outcomes_of(experiment, chosen, folder)
        kind = experiment.baseline and f"{experiment.baseline.kind}: "
        outcomes |= {(kind or "", odd): outcome for odd, outcome in told.items()}
    for (kind, odd), outcome in outcomes.items():
        if outcome not in (REFUSED, TRAINED):
            print(f"{kind}{odd.name} = {odd.value!r}: {outcome}")
    counts = collections.Counter(one if one in (REFUSED, TRAINED) else "neither" for one in outcomes.values())
    print(
        f"{len({(kind, odd.name) for kind, odd in outcomes})} fields, {len(outcomes)} values: "
        f"{counts[REFUSED]} {REFUSED}, "
        f"{counts[TRAINED]} {TRAINED}, {counts['neither']} neither (expected 0)"
    )
    return int(counts["neither"] > 0)


if __name__ == "__main__":
    with fail_with_message(), tempfile.TemporaryDirectory() as temporary:
        parsed = tyro.cli(Options, description=__doc__)
        place = parsed.folder or Path(temporary)
        place.mkdir(parents=True, exist_ok=True)
        sys.exit(main(parsed, place.absolute()))
