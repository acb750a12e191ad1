"""Writes docs/accelerators.md from the figures in benchmarks/results (a second).

Usage: python -m benchmarks.accelerator_page [--check]

Every file there named accelerator_*.json is what one run of benchmarks.accelerator wrote.
"""

import dataclasses
import sys
from pathlib import Path

import tyro

from benchmarks._accelerator.report import Report, flat, table
from benchmarks._accelerator.sections import SECTIONS
from dsvla_jax.command_line import fail_with_message

ROOT = Path(__file__).parent.parent
RESULTS, PAGE = ROOT / "benchmarks" / "results", ROOT / "docs" / "accelerators.md"

INTRODUCTION = """\
# Measured on accelerators

What `python -m benchmarks.accelerator` printed, run by run. All figures are in `benchmarks/results`, and
`python -m benchmarks.accelerator_page` writes this page from them. Utilisation is model FLOPs, without what
rematerialisation computes again, over the chip's published peak. Seconds are medians after a first call that compiles.
Weights are random.
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to do with the page."""

    check: bool = False
    """Exit with 1 if the page is not what would be written."""


def page() -> str:
    """The whole page."""
    parts, headlines = [INTRODUCTION], {section.name: section.headlines for section in SECTIONS}
    for file in sorted(RESULTS.glob("accelerator_*.json")):
        report = Report(file)
        devices = dict(flat(report.sections.get("devices", {"figures": {}})["figures"]))
        options = " ".join(report.content["command"])
        title = f"## {file.stem}" + (f": {devices['kind']}" if devices else "")
        command = f"python -m benchmarks.accelerator {options}"
        parts.append(f"{title}\n\n```sh\n{command}\n```\n\n```\n{table(report, headlines)}\n```\n")
    return "\n".join(parts)


def main(options: Options) -> int:
    """Writes the page, or compares it."""
    text = page()
    if options.check:
        return int(PAGE.read_text() != text)
    PAGE.write_text(text)
    print(f"{PAGE}: {len(list(RESULTS.glob('accelerator_*.json')))} runs")
    return 0


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
