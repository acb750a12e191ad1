"""The JSON file that benchmarks.accelerator writes: complete after every figure, whatever ends the program."""

import fnmatch
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# What becomes of a section. `skipped`: too little time was left for it.
WAITING, RUNNING, DONE, FAILED, SKIPPED = "waiting", "running", "done", "failed", "skipped"


class Report:
    """Sections by name, each with its state, seconds, figures and error. One process at a time may write it."""

    def __init__(self, path: Path):
        self.path = path
        self.content: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}

    @classmethod
    def start(cls, path: Path, names: list[str], **about: Any) -> "Report":
        """A new file in which the named sections wait, instead of any older one."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        report = cls(path)
        sections = {name: {"state": WAITING, "seconds": 0.0, "figures": {}, "error": ""} for name in names}
        report.content = {**about, "sections": sections}
        report._write()
        return report

    @property
    def sections(self) -> dict[str, dict[str, Any]]:
        """By name, in the order in which they run."""
        return self.content["sections"]

    def named(self, state: str) -> list[str]:
        """The sections in a state."""
        return [name for name, section in self.sections.items() if section["state"] == state]

    def update(self, name: str, **fields: Any) -> None:
        """Sets fields of a section."""
        self.sections[name].update(fields)
        self._write()

    def add(self, name: str, figures: dict[str, Any]) -> None:
        """Adds figures to a section."""
        self.sections[name]["figures"].update(figures)
        self._write()

    def _write(self) -> None:
        partial = self.path.with_name(f"{self.path.name}.{os.getpid()}")
        partial.write_text(json.dumps(self.content, indent=1) + "\n")
        partial.replace(self.path)


def flat(figures: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of nested figures, as ("batch 3/seconds", value)."""
    for name, value in figures.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{name}/")
        else:
            yield prefix + name, value


def table(report: Report, headlines: dict[str, tuple[str, ...]]) -> str:
    """Every section for people: its state, and of its figures those whose names match its headlines."""
    lines = []
    for name, section in report.sections.items():
        lines.append(f"{name:<18} {section['state']:<8} {section['seconds']:6.1f} s  {section['error'][:200]}".rstrip())
        for figure, value in flat(section["figures"]):
            if any(fnmatch.fnmatch(figure, pattern) for pattern in headlines.get(name, ())):
                text = f"{value:.4g}" if isinstance(value, float) else str(value)
                lines.append(f"    {figure:<44} {text}")
    return "\n".join(lines)
