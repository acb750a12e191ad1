"""Every field of every config with zero, negative, huge and contradicting values: refused, or two steps (30 minutes).

Usage: python -m benchmarks.odd_settings [--only model.vision --folder DIR]

Each value must end in one message without a run folder, or in two steps of training. What the settings alone show is
asked of all in this process; what passes is trained in processes of their own, whose memory is limited.
"""

import collections
import contextlib
import dataclasses
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
from typing import Any

import tyro
from tqdm import tqdm

import train
from data_pipelines.oxe.fixtures import write_fixture
from data_pipelines.samples import suite_tokenizer
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.errors import UserError
from dsvla_jax.training.distributed import Watchdog
from dsvla_jax.training.experiment import Experiment
from tests.odd_settings import OddSetting, odd_settings, toy_experiment

DATASET = "utokyo_xarm_bimanual_converted_externally_to_rlds"
# Nothing of the toy size needs more; a value that does must be refused before it is allocated.
MEMORY = 12 * 2**30
SECONDS = 600
# Runs of more steps are asked to stop once they have done two.
LONG = 100

REFUSED, TRAINED = "refused with a message", "trained two steps"


@dataclasses.dataclass(frozen=True)
class Options:
    """Which values."""

    only: str = ""
    """Fields whose names begin so; all if empty."""
    folder: Path | None = None
    """Where runs go; a temporary folder if not given."""
    workers: int = 1
    """Processes that train at a time."""


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


def from_settings_alone(experiment: Experiment, odd: OddSetting, run: Path) -> str:
    """What becomes of a value before anything is written; empty if it passes."""
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            train.prepare(odd.apply(experiment), run)
    except UserError:
        return REFUSED
    except Exception:
        return traceback.format_exc(limit=-1)
    return ""


def from_training(experiment: Experiment, odd: OddSetting, run: Path) -> str:
    """What becomes of a value in a run of two steps."""
    changed = odd.apply(experiment)
    if changed.steps > LONG:
        threading.Thread(target=_stop_after_two_steps, args=(run,), daemon=True).start()
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            train.main(changed, run, Watchdog(run / "processes"))
    except UserError as error:
        return f"a run folder, and {error}" if run.exists() else REFUSED
    except Exception:
        return traceback.format_exc(limit=-3)
    return TRAINED if _steps_of(run) >= 2 else "no two steps"


def _stop_after_two_steps(run: Path) -> None:
    while _steps_of(run) < 2:
        time.sleep(0.1)
    os.kill(os.getpid(), signal.SIGTERM)


def _steps_of(run: Path) -> int:
    file = run / "metrics.jsonl"
    return file.read_text().count('"step"') if file.exists() else 0


def start_worker() -> None:
    """Limits the memory of this process, and lets it compile nothing twice."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    configure_jax()


def train_all(jobs: list[tuple[Experiment, OddSetting, Path]], workers: int) -> list[str]:
    """The outcome of each. A process that dies, or takes too long, is another's end only if it ran beside it."""
    outcomes, context = [], multiprocessing.get_context("spawn")
    for start in tqdm(range(0, len(jobs), workers), desc="training", disable=None):
        pool = _pools.setdefault("pool", ProcessPoolExecutor(workers, context, start_worker))
        for future in [pool.submit(from_training, *job) for job in jobs[start : start + workers]]:
            try:
                outcomes.append(future.result(timeout=SECONDS))
            except Exception as error:
                outcomes.append(f"the process ended: {error!r}")
                _end(_pools.pop("pool", None))
    _end(_pools.pop("pool", None))
    return outcomes


_pools: dict[str, Any] = {}


def _end(pool: ProcessPoolExecutor | None) -> None:
    if pool is not None:
        for process in (pool._processes or {}).values():
            process.kill()
        pool.shutdown(wait=False, cancel_futures=True)


def main(options: Options, folder: Path) -> int:
    """Prints the figures, and each value that is neither refused nor trained. Returns the exit status."""
    toy = toy_experiment(folder)
    odds = [(experiment, odd) for experiment in (toy, oxe_experiment(toy, folder)) for odd in odd_settings(experiment)]
    # Of the second experiment only what the first does not have.
    odds = [(one, odd) for one, odd in odds if odd.name.startswith("oxe.") == (one.oxe is not None)]
    odds = [(one, odd) for one, odd in odds if odd.name.startswith(options.only)]
    outcomes = [from_settings_alone(one, odd, folder / "run") for one, odd in odds]
    written = (folder / "run").exists()
    passed = [place for place, outcome in enumerate(outcomes) if not outcome]
    jobs = [(*odds[place], folder / f"run{place}") for place in passed]
    for place, outcome in zip(passed, train_all(jobs, options.workers), strict=True):
        outcomes[place] = outcome
    for (_, odd), outcome in zip(odds, outcomes, strict=True):
        if outcome not in (REFUSED, TRAINED):
            print(f"{odd.name} = {odd.value!r}: {outcome}")
    counts = collections.Counter(outcome if outcome in (REFUSED, TRAINED) else "neither" for outcome in outcomes)
    fields = len({odd.name for _, odd in odds})
    print(
        f"{fields} fields, {len(odds)} values: {counts[REFUSED]} {REFUSED}, {counts[TRAINED]} {TRAINED}, "
        f"{counts['neither']} neither (expected 0)"
    )
    return int(counts["neither"] > 0 or written)


if __name__ == "__main__":
    with fail_with_message(), tempfile.TemporaryDirectory() as temporary:
        parsed = tyro.cli(Options, description=__doc__)
        place = parsed.folder or Path(temporary)
        place.mkdir(parents=True, exist_ok=True)
        sys.exit(main(parsed, place.absolute()))
