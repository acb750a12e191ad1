"""One script for one accelerator: training, decoding and simulation measured, as JSON and a table (8 minutes, one GPU).

Usage: python -m benchmarks.accelerator [--out FILE.json] [--sections paper_7b_train,render] [--seconds 480]

Sections run in a process of their own. One that fails, or takes the process with it, is recorded with its error, and
the next ones run; one for which too little time is left is skipped. FILE.json is complete after every figure. What is
compared with the CPU, and the demonstrations of `tiny`, are made beside the first sections by a process that sees the
CPU alone. On a machine without a network, install first what benchmarks.accelerator_wheels gathers. With --size toy
everything takes about a minute on a laptop's CPU, and the figures mean nothing.
"""

import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import tyro

from benchmarks._accelerator.report import FAILED, RUNNING, SKIPPED, WAITING, Report, table
from benchmarks._accelerator.sections import SECTIONS, Size, choose, prepared_file, problem_file
from benchmarks._accelerator.worker import say
from dsvla_jax.command_line import fail_with_message

ROOT = Path(__file__).parent.parent
# Of the device's memory: JAX takes it at once, and leaves the rest to the libraries.
MEMORY_SHARE = "0.9"


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure, and for how long."""

    out: Path = Path("accelerator.json")
    """The file to write."""
    sections: tuple[str, ...] = ("all",)
    """Names, with commas or spaces between."""
    seconds: float = 480.0
    """After so many the program ends, whatever is still running."""
    size: Size = "full"
    """`toy` tries everything in a minute."""
    folder: Path = Path("runs/accelerator")
    """For demonstrations, the run of `tiny`, and what is compared with the CPU."""


def supervise(
    report: Report, start: Callable[[list[str]], "subprocess.Popen[bytes]"], began: float, until: float
) -> None:
    """Starts a process for the waiting sections, and another one for the rest if it ends early, until none waits.

    start: runs the sections of these names, and writes the report.
    """
    while (waiting := report.named(WAITING)) and time.time() < until:
        process = start(waiting)
        try:
            process.wait(max(0.0, until - time.time()))
            ending = f"its process ended with status {process.returncode}"
        except subprocess.TimeoutExpired:
            ending = "stopped: no time was left"
        finally:
            end(process)
        report = Report(report.path)
        unfinished = report.named(RUNNING)
        if not unfinished and report.named(WAITING) == waiting and time.time() < until:
            # It did not come as far as its first section, and would not the next time either.
            unfinished = waiting[:1]
        for name in unfinished:
            report.update(name, state=FAILED, error=ending)
            say(began, name, ending)
    for name in report.named(WAITING):
        report.update(name, state=SKIPPED, error="no time was left")


def end(process: "subprocess.Popen[bytes]") -> None:
    """Ends a process that may have ended."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def note_early_end(process: "subprocess.Popen[bytes]", folder: Path, needs: Sequence[str]) -> None:
    """Waits for the process that prepares things, and where it was killed lets nobody wait for what it did not make."""
    if process.wait():
        for need in needs:
            if not prepared_file(folder, need).exists():
                problem_file(folder, need).write_text(f"the process ended with status {process.returncode}")


def main(options: Options) -> int:
    """Measures, prints the table, and returns 1 if a section failed."""
    sections, began = choose(options.sections), time.time()
    until = began + options.seconds
    folder = (options.folder / options.size).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    needs = list(dict.fromkeys(need for section in sections for need in section.needs))
    for need in needs:
        prepared_file(folder, need).unlink(missing_ok=True)
        problem_file(folder, need).unlink(missing_ok=True)
    report = Report.start(
        options.out.absolute(),
        [section.name for section in sections],
        size=options.size,
        seconds=options.seconds,
        command=sys.argv[1:],
    )
    environment = {"XLA_PYTHON_CLIENT_MEM_FRACTION": MEMORY_SHARE, **os.environ}
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    environment = {**environment, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"}

    def run(module: str, arguments: Sequence[str], **more: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", f"benchmarks._accelerator.{module}", *arguments]
        return subprocess.Popen(command, env={**environment, **more})

    def start(names: list[str]) -> "subprocess.Popen[bytes]":
        return run("worker", [str(report.path), str(folder), options.size, str(began), str(until), *names])

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    beside = run("reference", [str(folder), options.size, *needs], JAX_PLATFORMS="cpu") if needs else None
    if beside is not None:
        threading.Thread(target=note_early_end, args=(beside, folder, needs), daemon=True).start()
    try:
        supervise(report, start, began, until)
    finally:
        if beside is not None:
            end(beside)
        report = Report(report.path)
        print(table(report, {section.name: section.headlines for section in SECTIONS}))
        print(f"{time.time() - began:.0f} s; all figures: {report.path}")
    return int(bool(report.named(FAILED)))


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
