"""`pip install .` and `pip install -e ".[gguf]"` in empty environments, and what is installed (10 minutes, network).

Usage: python -m benchmarks.install [--clone FOLDER]

Both install from a fresh clone of the last commit. Then, from another folder, the packages are imported, every program
parses --help, and a config outside of the project is found. The wheel must hold every file of the three packages that
git knows, and the licence. Exits with 1 if anything fails.
"""

import dataclasses
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import tyro

from dsvla_jax.command_line import fail_with_message

ROOT = Path(__file__).parent.parent
PACKAGES = ("dsvla_jax", "data_pipelines", "configs")
CONFIG = """
from dataclasses import replace

from configs.tiny import config as tiny


def config():
    return replace(tiny(), steps=3)
"""
CHECKS = (
    ("python", "-c", f"import {', '.join(PACKAGES)}"),
    ("python", "-c", "from dsvla_jax.serving.client import PolicyClient"),
    ("dsvla-train", "own.py", "--help"),
    ("dsvla-eval", "--help"),
    ("python", "-m", "data_pipelines.demos", "out", "--tasks", "lamp_on", "--episodes", "1"),
    ("python", "-m", "data_pipelines.inspect", "out"),
    ("python", "-m", "data_pipelines.oxe", "list"),
    ("python", "-m", "data_pipelines.rlbench", "--help"),
    ("python", "-m", "data_pipelines.vocabulary", "--help"),
    ("python", "-m", "data_pipelines.find_keypoints", "--help"),
    ("python", "-m", "dsvla_jax.weights", "import", "--help"),
    ("dsvla-plan", "own.py", "--help"),
    ("python", "-m", "dsvla_jax.serving", "--help"),
    ("python", "-m", "dsvla_jax.evaluation.demo", "--help"),
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What to install."""

    clone: Path | None = None
    """A clone to install from; a fresh one of this repository if not given."""


def run(*command: str, folder: Path, binaries: Path) -> bool:
    """Runs a command with a virtual environment's programs, prints how long it took, and returns whether it worked."""
    environment = {key: os.environ[key] for key in os.environ.keys() - {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"}}
    environment["PATH"] = f"{binaries}:{environment['PATH']}"
    started = time.monotonic()
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    worked = done.returncode == 0
    print(f"{'ok' if worked else 'FAILED':7}{time.monotonic() - started:4.0f} s  {' '.join(command)}", flush=True)
    if not worked:
        print((done.stdout + done.stderr)[-3000:])
    return worked


def missing_files(clone: Path, wheel: Path) -> list[str]:
    """Returns the files of the packages, and the licence, that a wheel lacks."""
    listed = subprocess.run(["git", "ls-files", *PACKAGES], cwd=clone, capture_output=True, text=True, check=True)
    held = zipfile.ZipFile(wheel).namelist()
    licence = [] if any(name.endswith("licenses/LICENSE") for name in held) else ["LICENSE"]
    return sorted(set(listed.stdout.split()) - set(held)) + licence


def main(options: Options) -> int:
    """Prints a line for each step; 0 if all worked."""
    python = getattr(sys, "_base_executable", sys.executable)
    worked = True
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        clone = options.clone.resolve() if options.clone else work / "clone"
        if not options.clone:
            subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        elsewhere = work / "elsewhere"
        elsewhere.mkdir()
        (elsewhere / "own.py").write_text(CONFIG)
        for name, what in (("plain", ["."]), ("editable", ["-e", ".[gguf]"])):
            binaries = work / name / "bin"
            subprocess.run([python, "-m", "venv", str(work / name)], check=True)
            worked &= run("pip", "install", "--quiet", *what, folder=clone, binaries=binaries)
            for check in CHECKS:
                worked &= run(*check, folder=elsewhere, binaries=binaries)
        worked &= run("python", "-c", "import gguf", folder=elsewhere, binaries=work / "editable" / "bin")
        wheels = work / "wheels"
        worked &= run(
            *("pip", "wheel", "--quiet", "--no-deps", "-w", str(wheels), "."),
            folder=clone,
            binaries=work / "plain" / "bin",
        )
        missing = [name for wheel in wheels.glob("*.whl") for name in missing_files(clone, wheel)]
        print(f"the wheel lacks: {', '.join(missing) or 'nothing'}")
    return int(not worked or bool(missing))


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
