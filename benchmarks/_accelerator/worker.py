"""Runs sections one after the other in a process of their own: python -m benchmarks._accelerator.worker, see `main`.

A process that an error may have left without memory, or without a usable device, measures nothing else: it ends after
the first section that fails, and benchmarks.accelerator starts another one for the rest.
"""

import gc
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

from benchmarks._accelerator.report import DONE, FAILED, RUNNING, SKIPPED, Report
from benchmarks._accelerator.sections import SIZES, Job, Section, Sizes, choose

# Status of a process that ended because a section failed.
SECTION_FAILED = 3


def run_sections(
    sections: Sequence[Section], sizes: Sizes, report: Report, folder: Path, began: float, until: float
) -> bool:
    """Runs them, each if the time that is left suffices. Returns whether none failed.

    began, until: by `time.time`, the start of the whole benchmark and its end.
    """
    shared: dict[str, object] = {}
    previous = ""
    for section in sections:
        if section.module != previous:
            shared.clear()
            gc.collect()
            previous = section.module
        left, needed = until - time.time(), section.seconds if sizes.name == "full" else 0.0
        if left < needed:
            error = f"takes about {needed:.0f} s, {left:.0f} s were left"
            report.update(section.name, state=SKIPPED, error=error)
            say(began, section.name, f"skipped: {error}")
            continue
        report.update(section.name, state=RUNNING)
        say(began, section.name, f"about {section.seconds:.0f} s" if sizes.name == "full" else "")
        start = time.time()

        def note(section: Section = section, **figures: object) -> None:
            report.add(section.name, figures)

        job = Job(sizes, folder, note, lambda: until - time.time(), shared)
        try:
            section.run(job)
        except (Exception, SystemExit) as error:
            traceback.print_exc()
            text = f"{type(error).__name__}: {error}"
            report.update(section.name, state=FAILED, seconds=time.time() - start, error=text)
            say(began, section.name, f"failed: {text.splitlines()[0]}")
            return False
        report.update(section.name, state=DONE, seconds=time.time() - start)
        say(began, section.name, f"done in {time.time() - start:.1f} s")
    return True


def say(began: float, name: str, text: str) -> None:
    """One line of progress."""
    print(f"[{time.time() - began:5.0f} s] {name}: {text}".rstrip(": "), flush=True)


def main(out: str, folder: str, size: str, began: str, until: str, *names: str) -> int:
    """Runs the sections of these names; the arguments are those of `run_sections`, and the report's file."""
    import jax

    from dsvla_jax.command_line import configure_jax

    sections, report = choose(names), Report(Path(out))
    configure_jax("mjx" if any(name.startswith("mjx") or name == "equal_episodes" for name in names) else "mujoco")
    if size == "full" and jax.default_backend() == "cpu":
        for name in names:
            report.update(name, state=FAILED, error="JAX has no accelerator here; on a CPU use --size toy")
        return SECTION_FAILED
    fine = run_sections(sections, SIZES[size], report, Path(folder), float(began), float(until))
    return 0 if fine else SECTION_FAILED


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
