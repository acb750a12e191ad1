"""Training, loading, demonstrations and evaluation take at most 1.03x as long as in another commit (15 minutes).

Usage: python -m benchmarks.against_commit COMMIT [--rounds 5]

The two trees alternate, with the same commands and this Python. Each has its own compilation cache, which a first round
fills. A figure is the least seconds of its repeats in all rounds: what else the machine does only ever adds to them.
Uncommitted changes belong to this tree.
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

import tyro
from rich.console import Console
from rich.table import Table

from dsvla_jax.command_line import fail_with_message
from dsvla_jax.errors import UserError

ROOT = Path(__file__).parent.parent
TRAIN = "train.py tiny --steps 60 --log-every 5 --checkpoint-every 0 --data.tasks lamp_on --data.episodes 40"
# Names that a commit has moved are looked up in both places.
LOADER = """
import time
from configs import get_config
from data_pipelines.loader import make_loader
from data_pipelines.samples import make_sampler
from data_pipelines.sources import open_demonstrations
try:
    from dsvla_jax.suite_vocabulary import suite_tokenizer
except ImportError:
    from data_pipelines.samples import suite_tokenizer
experiment, tokenizer = get_config("tiny"), suite_tokenizer()
reader = open_demonstrations(experiment.data.__class__(tasks=("lamp_on",), episodes=40), tokenizer)
sample = make_sampler(experiment.data, experiment.encoding, tokenizer)
batches = make_loader(reader, sample, batch_size=32, seed=0, process_index=0, process_count=1, num_threads=0)
seconds = []
for _ in range(20):
    start = time.perf_counter()
    for _ in range(10):
        next(batches)
    seconds.append((time.perf_counter() - start) / 10)
print(min(seconds))
"""
DEMONSTRATIONS = """
import time
from data_pipelines.demos import ScriptedExpert, Settings
from dsvla_jax.command_line import configure_jax
configure_jax()
expert, seconds = ScriptedExpert("lamp_on", Settings()), []
for start in range(0, 240, 20):
    began = time.perf_counter()
    expert(start, 20)
    seconds.append(time.perf_counter() - began)
print(min(seconds))
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to compare with."""

    commit: tyro.conf.Positional[str]
    """A commit of this repository."""
    rounds: int = 5
    """How often each figure is measured in each tree, besides the first round, which compiles."""
    limit: float = 1.03
    """The largest ratio that passes."""


@dataclasses.dataclass(frozen=True)
class Tree:
    """A checked-out tree, and a folder for what its programs write."""

    source: Path
    folder: Path

    def run(self, *arguments: str) -> str:
        """Runs Python on the tree's code in the folder; returns what it prints."""
        environment = {**os.environ, "PYTHONPATH": str(self.source), "XDG_CACHE_HOME": str(self.folder / "cache")}
        command = [sys.executable, *arguments]
        done = subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise UserError(f"{self.source}: {' '.join(arguments)[:80]}: {done.stderr[-2000:]}")
        return done.stdout

    def seconds(self, *arguments: str) -> float:
        """Seconds that Python takes on the tree's code."""
        start = time.perf_counter()
        self.run(*arguments)
        return time.perf_counter() - start


def training_step(tree: Tree, number: int) -> float:
    """Seconds of a step of `tiny`, of the fastest ten in a row. Makes the demonstrations and the run of the others."""
    run = tree.folder / f"run{number}"
    program, *options = TRAIN.split()
    tree.run(str(tree.source / program), *options, "--run", str(run))
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return min(line["seconds_per_step"] for line in lines if "seconds_per_step" in line)


def loading(tree: Tree, number: int) -> float:
    """Seconds of a batch of 32 examples."""
    return float(tree.run("-c", LOADER).split()[-1])


def demonstrations(tree: Tree, number: int) -> float:
    """Seconds of 20 demonstrations: keyframes in C MuJoCo, pictures and keypoints."""
    return float(tree.run("-c", DEMONSTRATIONS).split()[-1])


def evaluation(tree: Tree, number: int) -> float:
    """Seconds of 50 episodes of a policy that knows little: encoding, decoding and keyframes in C MuJoCo."""
    return tree.seconds(
        str(tree.source / "eval.py"), str(tree.folder / f"run{number}"), "--tasks", "lamp_on", "--episodes", "50"
    )


FIGURES: tuple[Callable[[Tree, int], float], ...] = (training_step, loading, demonstrations, evaluation)


def main(options: Options) -> int:
    """Compares; 0 if no ratio is above the limit."""
    with tempfile.TemporaryDirectory() as temporary:
        other = Path(temporary, "other")
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(other), options.commit], check=True)
        try:
            trees = [Tree(source, Path(temporary, name)) for source, name in ((ROOT, "here"), (other, "there"))]
            for tree in trees:
                tree.folder.mkdir()
            taken = measure(trees, options.rounds)
        finally:
            subprocess.run([*git, "remove", "--force", str(other)], check=True)
    table = Table("figure", "seconds here", f"in {options.commit}", "ratio")
    ratios: list[float] = []
    for name, rounds in taken.items():
        here, there = map(min, zip(*rounds, strict=True))
        ratios.append(here / there)
        table.add_row(name, f"{here:.4f}", f"{there:.4f}", f"{ratios[-1]:.3f}")
    Console().print(table)
    print(f"largest ratio: {max(ratios):.3f} (at most {options.limit})")
    return int(max(ratios) > options.limit)


def measure(trees: list[Tree], rounds: int) -> dict[str, list[tuple[float, float]]]:
    """The seconds of each figure in each round, in both trees. Who comes first alternates."""
    taken: dict[str, list[tuple[float, float]]] = {figure.__name__: [] for figure in FIGURES}
    for number in range(rounds + 1):
        for figure in FIGURES:
            order = (0, 1) if number % 2 else (1, 0)
            seconds = {index: figure(trees[index], number) for index in order}
            if number:
                taken[figure.__name__].append((seconds[0], seconds[1]))
                print(f"round {number}, {figure.__name__}: {seconds[0]:.4f} s, {seconds[1]:.4f} s", flush=True)
    return taken


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
