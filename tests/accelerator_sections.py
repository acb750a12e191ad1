"""Sections of benchmarks.accelerator that end in every way: python -m tests.accelerator_sections REPORT NAME ..."""

import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

from benchmarks._accelerator.report import Report
from benchmarks._accelerator.sections import SIZES, Job, Section
from benchmarks._accelerator.worker import SECTION_FAILED, run_sections
from dsvla_jax.errors import UserError


def good(job: Job) -> None:
    job.note(answer=42)


def broken(job: Job) -> None:
    job.note(half=1)
    raise ValueError("no such kernel")


def killed(job: Job) -> None:
    job.note(half=2)
    os.kill(os.getpid(), signal.SIGKILL)


def endless(job: Job) -> None:
    job.note(half=3)
    threading.Event().wait()


def last(job: Job) -> None:
    job.note(answer=43)


def platforms_expert(task: str, settings: Any) -> Any:
    """In the place of a scripted expert: says on what JAX runs in the process that demonstrates."""
    raise UserError(f"platforms: {sys.modules['jax'].config.jax_platforms}")


def sections(*names: str, seconds: float = 0.0) -> list[Section]:
    """The functions of this module as sections."""
    return [Section(name, f"{__name__}:{name}", seconds, ()) for name in names]


if __name__ == "__main__":
    __name__ = "tests.accelerator_sections"
    now = time.time()
    fine = run_sections(sections(*sys.argv[2:]), SIZES["full"], Report(Path(sys.argv[1])), Path("."), now, now + 600)
    sys.exit(0 if fine else SECTION_FAILED)
