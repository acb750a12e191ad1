"""Every command of README and docs, as written, in a fresh clone; long ones at toy size (30 minutes, and network).

Usage: python -m benchmarks.documented_commands [--pages README.md docs/training.md] [--folder FOLDER] [--list]

The clone is of the last commit. Commands run in the order of the pages, README first, in the virtual environment that
`make` makes there. RULES below says which run with smaller numbers, and which cannot run everywhere; of those only the
options are parsed, as tests/test_commands.py does for all. Prints a table, and exits with 1 if a command fails.
"""

import contextlib
import dataclasses
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks._commands import ROOT, Command, example_files, find_commands, indented_commands, pages, problem_with
from dsvla_jax.command_line import fail_with_message
from dsvla_jax.errors import UserError

LIMIT = 1800  # seconds a command
HEALTH = "http://127.0.0.1:8000/healthz"


@dataclasses.dataclass(frozen=True)
class Rule:
    """How commands that a pattern is found in are run; the first rule that fits counts."""

    pattern: str
    toy: str = ""
    """Options at toy size, in the place of the command's own values of them."""
    words: dict[str, str] = dataclasses.field(default_factory=dict)
    """What stands for the reader's own paths."""
    only_parsed: str = ""
    """Why the command is not run."""
    serves: bool = False
    """Runs until the page ends; the next command waits until it is ready."""
    fails: str = ""
    """Status 1 is right if this is printed, because what was trained at toy size has learned nothing."""


TASKS = "lamp_on bimanual_lift_ball"
TRAIN = "--steps 2 --batch-size 4 --data.episodes 4"
OWN = {
    "RUN": "runs/tiny",
    "SRC": "toy/rlbench",
    "LLAMA": "tests/golden/llama_sharded",
    "CLIP": "tests/golden/clip",
    "CONFIG ...": "tiny",
    "NAME ...": "viola",
    "NAME": "viola",
}
TOY_RECORDINGS = """
from pathlib import Path
from tests.rlbench_files import write_dataset
write_dataset(Path("toy/rlbench"), ["lamp_on"], size=96, descriptions=["turn on the light"], cameras=["front", "wrist"])
"""
GOLDEN = "tests/golden/original"
ORIGINAL = {"SRC": f"{GOLDEN}/llama", "SRC2": f"{GOLDEN}/clip.pt", "OUT": "bases/mine"}

RULES = (
    Rule("^make train", f'TRAIN_OPTIONS="{TRAIN}" EVAL_OPTIONS="--episodes 1"'),
    Rule("^make test", 'PYTEST_ADDOPTS="-k linked_files"'),
    Rule("^make bench"),
    Rule("^make setup"),
    Rule("^make (parity|lock)", only_parsed="installs PyTorch and TensorFlow, or resolves the lock again"),
    Rule(r"^pip install -e \S*(perception|parity)", only_parsed="installs PyTorch"),
    Rule("git.URL", only_parsed="needs the address of a repository"),
    Rule("^pip install"),
    Rule("^(sbatch|kubectl)", only_parsed="needs a cluster"),
    Rule("^gsutil|gs://", only_parsed="reads a bucket"),
    Rule("train.py paper_7b", only_parsed="needs LLaMA's weights and accelerators"),
    Rule("train.py tiny_oxe( --| ?$)", "--steps 2 --batch-size 4"),
    Rule("train.py .*--data.source episodes", "--steps 2 --batch-size 4"),
    Rule("train.py .*--validate-every", f"{TRAIN} --validate-every 2 --validation.episodes 1 --validation.batches 1"),
    Rule("train.py .*--evaluate-every", f"{TRAIN} --evaluate-every 2 --evaluation.episodes-while-training 1"),
    Rule("train.py .*--help"),
    Rule("train.py (suite|.*--data.tasks all)", f"{TRAIN} --data.tasks {TASKS}"),
    Rule("train.py", TRAIN),
    Rule("eval.py .*--compare"),
    Rule("eval.py .*--physics mjx", "--episodes 1 --tasks lamp_on"),
    Rule("eval.py runs/suite", f"--episodes 1 --tasks {TASKS}"),
    Rule("eval.py .*--step best", "--episodes 1 --tasks lamp_on", {"RUN": "runs/validated"}),
    Rule("eval.py", "--episodes 1 --tasks lamp_on", OWN),
    Rule("data_pipelines.demos .*--cameras", "--episodes 4"),
    Rule("data_pipelines.demos", f"--episodes 4 --tasks {TASKS}"),
    Rule("data_pipelines.find_keypoints|--perception", only_parsed="needs PyTorch and weights from a hub"),
    Rule("data_pipelines", words=OWN),
    Rule("weights import .*--adapter-heads", "--adapter-heads 3", {**ORIGINAL, "FILE": f"{GOLDEN}/adapter.pth"}),
    Rule("weights import SRC", words=ORIGINAL),
    Rule("weights import", words=OWN),
    Rule("weights export", words={"RUN": "runs/tiny_lora", "runs/paper_7b": "runs/tiny_lora", "OUT": "exports/run"}),
    Rule("plan.py .*--search", "--topology v5e:2x2", {"paper_7b": "tiny_lora"}),
    Rule("plan.py .*--examples", "--examples 8 16"),
    Rule("plan.py"),
    Rule("dsvla_jax.serving", words=OWN, serves=True),
    Rule("robot_client", "--keyframes 2", fails="no success"),
    Rule("dsvla_jax.evaluation.demo"),
    Rule("expert_success", "--episodes 4"),
    Rule("raycast_parity"),
    Rule("benchmarks|docs.gallery", only_parsed="a check of minutes by itself"),
    Rule("pytest -m weights"),
    Rule(r"^python record\.py$"),
)


def rule_of(command: Command) -> Rule | None:
    """Returns the rule for a command, or None for one that the table does not know."""
    return next((rule for rule in RULES if re.search(rule.pattern, command.text)), None)


def text_to_run(command: Command, rule: Rule) -> str:
    """Returns a command with the reader's own paths and the options of toy size filled in."""
    text = command.text
    for word in sorted(rule.words, key=len, reverse=True):
        text = re.sub(rf"(?<![\w/]){re.escape(word)}(?![\w/])", rule.words[word], text)
    if command.only_names:
        return f"{text} --help"
    for option in re.findall(r"--[\w.-]+", rule.toy) if not text.startswith("make") else ():
        text = re.sub(rf" {re.escape(option)}(?: (?!-)[^\s;&|]+)*", "", text)
    if rule.toy:
        text = re.sub(r"((?:python|make) [^\n;&|]*[^\n;&| ])", lambda match: f"{match[1]} {rule.toy}", text)
    return text


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run, and where."""

    pages: tuple[str, ...] = ()
    """Only these, as README.md or docs/training.md; a later page may need what an earlier one made."""
    folder: Path | None = None
    """Where to clone to, and what to go on in if it is there; a temporary folder if not given."""
    list: bool = False
    """Only say what would be run."""


@dataclasses.dataclass(frozen=True)
class Result:
    """What became of a command."""

    where: str
    text: str
    status: str
    seconds: float = 0.0


class Clone:
    """A fresh clone with its virtual environment."""

    def __init__(self, folder: Path):
        self.folder = folder
        if not folder.exists():
            subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
        kept = {key: os.environ[key] for key in os.environ.keys() - {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"}}
        python = getattr(sys, "_base_executable", sys.executable)
        venv = folder / f".venv-{sys.version_info.major}.{sys.version_info.minor}" / "bin"
        self.environment = {**kept, "PYTHON": python, "PATH": f"{venv}:{os.environ['PATH']}", "COLUMNS": "160"}

    def run(self, text: str, fails: str = "") -> tuple[str, str]:
        """Runs a command in the clone's root; returns "ok" or what went wrong, and the output."""
        command = ["bash", "-c", f"set -e -o pipefail\n{text}"]
        try:
            done = subprocess.run(
                command,
                cwd=self.folder,
                env=self.environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=LIMIT,
            )
        except subprocess.TimeoutExpired as error:
            return f"over {LIMIT} s", str(error.output or "")
        right = done.returncode == 0 or (done.returncode == 1 and fails and fails in done.stdout)
        # A loop that starts programs in the background says nothing of their status.
        if right and not re.search(r"^(error: |Traceback \(most recent call last\))", done.stdout, re.MULTILINE):
            return "ok", done.stdout
        return f"status {done.returncode}", done.stdout

    @contextlib.contextmanager
    def serving(self, text: str) -> Iterator[str]:
        """Keeps a server running; gives "ok" once it is ready."""
        with (self.folder / "server.log").open("w") as log:
            process = subprocess.Popen(
                ["bash", "-c", f"exec {text}"], cwd=self.folder, env=self.environment, stdout=log, stderr=log
            )
            try:
                end = time.monotonic() + LIMIT
                while process.poll() is None and not is_ready() and time.monotonic() < end:
                    time.sleep(1)
                yield "ok" if is_ready() else f"status {process.poll()}; see server.log"
            finally:
                process.send_signal(signal.SIGINT)
                process.wait(60)


def is_ready() -> bool:
    """Whether the server of the docs has compiled its programs."""
    try:
        return urllib.request.urlopen(HEALTH, timeout=5).status == 200
    except OSError:
        return False


def run_page(clone: Clone, page: Path, earlier: list[Result], console: Console) -> list[Result]:
    """Runs the commands of a page that no earlier page has, and prints each as it ends."""
    for path, text in example_files(page).items():
        file = clone.folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    results: list[Result] = []
    with contextlib.ExitStack() as servers:
        for command in find_commands(page, clone.folder):
            rule, started = rule_of(command), time.monotonic()
            text = text_to_run(command, rule) if rule else command.text
            same = next((result.where for result in [*earlier, *results] if result.text == text), "")
            output = ""
            if rule is None:
                status = "not in RULES"
            elif rule.only_parsed:
                status = problem_with(command) or f"parsed: {rule.only_parsed}"
            elif rule.serves:
                servers.close()
                status = servers.enter_context(clone.serving(text))
            elif same:
                status = f"same as {same}"
            else:
                status, output = clone.run(text, rule.fails)
            result = Result(command.where, text, status, time.monotonic() - started)
            console.print(f"{result.where}  {status}  {result.seconds:.0f} s  {text}", markup=False)
            if not succeeded(result):
                console.print(output[-3000:], markup=False)
            results.append(result)
    return results


def succeeded(result: Result) -> bool:
    """Whether a command did what it should."""
    return result.status == "ok" or result.status.startswith(("parsed: ", "same as "))


def prepare(clone: Clone) -> None:
    """Makes the virtual environment, and what stands for the reader's own recordings and Open X-Embodiment data."""
    status, output = clone.run("make setup")
    if status != "ok":
        raise UserError(f"make setup: {status}\n{output}")
    if not (clone.folder / "toy").exists():
        status, output = clone.run(f"python -c {shlex.quote(TOY_RECORDINGS)}")
        if status != "ok":
            raise UserError(f"toy recordings: {status}\n{output}")
        (clone.folder / "data").mkdir(exist_ok=True)
        (clone.folder / "data" / "oxe").symlink_to("oxe_fixtures")


def chosen_pages(options: Options, root: Path) -> list[Path]:
    """Returns the pages that the options ask for; all if they name none."""
    every = {page.relative_to(root).as_posix(): page for page in pages(root)}
    if unknown := [name for name in options.pages if name not in every]:
        raise UserError(f"--pages: no page {unknown[0]!r}; expected some of: {', '.join(every)}")
    return [page for name, page in every.items() if not options.pages or name in options.pages]


def main(options: Options) -> int:
    """Runs all; 0 if every command does what it should."""
    console = Console(width=200)
    if options.list:
        for command in (command for page in chosen_pages(options, ROOT) for command in find_commands(page)):
            rule = rule_of(command)
            text = f"not run: {rule.only_parsed}" if rule and rule.only_parsed else rule and text_to_run(command, rule)
            console.print(f"{command.where}  {command.text}\n    {text}", markup=False)
        return 0
    temporary = tempfile.mkdtemp() if options.folder is None else ""
    clone = Clone(options.folder.resolve() if options.folder else Path(temporary) / "clone")
    try:
        started = time.monotonic()
        prepare(clone)
        results = [Result("README.md", "git clone; make setup", "ok", time.monotonic() - started)]
        for page in chosen_pages(options, clone.folder):
            results += run_page(clone, page, results, console)
            results += [Result(page.name, line, "not in an ```sh block") for line in indented_commands(page)]
    finally:
        if temporary:
            shutil.rmtree(temporary)
    table = Table("command", "where", "status", "s")
    for result in results:
        table.add_row(result.text, result.where, result.status, f"{result.seconds:.0f}")
    console.print(table)
    failed = [result for result in results if not succeeded(result)]
    ran = sum(result.status == "ok" for result in results)
    print(f"{ran} ran, {len(results) - ran - len(failed)} parsed only or the same as another, {len(failed)} failed")
    return int(bool(failed))


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
