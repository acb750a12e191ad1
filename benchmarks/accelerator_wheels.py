"""Gathers the wheels that a machine without a network lacks for benchmarks.accelerator (needs a network; 1 minute).

Usage: python -m benchmarks.accelerator_wheels OUT [--python 3.12] [--packages mujoco ...] [--limit-mb 60]

The other machine is expected to have an x86-64 Linux, Python, NumPy, SciPy, JAX for its accelerator, flax, optax,
orbax-checkpoint and OpenCV. Versions and hashes are those of requirements.lock, and nothing that the wheels depend on
comes with them. Copy the repository and OUT there, and run, in the repository:

    python3 -m pip install --no-index --no-deps --no-compile --target site OUT/*.whl && \\
    PYTHONPATH=site python3 -m benchmarks.accelerator --seconds 420 --out accelerator.json

The first command leaves the packages that are installed there as they are. Where the time of one call is short, name
the sections of each: --sections devices,paper_7b_train,paper_7b_decode, and the others in a second call.
"""

import dataclasses
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import tyro
from packaging.requirements import Requirement

from dsvla_jax.command_line import fail_with_message
from dsvla_jax.errors import UserError

LOCK = Path(__file__).parent.parent / "requirements.lock"
PACKAGES = (
    "mujoco",
    "mujoco-mjx",
    "grain",
    "array-record",
    "tyro",
    "typeguard",
    "docstring-parser",
    "cattrs",
    "tensorboardx",
    "trimesh",
    "importlib-resources",
    "portpicker",
)
# pip takes these tags word by word: a wheel for an older libc is found by its own tag alone.
PLATFORMS = (
    *(f"manylinux_2_{minor}_x86_64" for minor in (28, 27, 26, 24, 17, 12, 5)),
    "manylinux2014_x86_64",
    "manylinux2010_x86_64",
    "manylinux1_x86_64",
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What to gather, for which machine."""

    out: tyro.conf.Positional[Path]
    """The folder to write; wheels that are there already stay."""
    python: str = "3.12"
    """The other machine's version of Python."""
    packages: tuple[str, ...] = PACKAGES
    """Packages of requirements.lock."""
    limit_mb: float = 60.0
    """Exit with 1 if they are larger together."""


def locked(text: str) -> Iterator[tuple[Requirement, list[str]]]:
    """The requirements of a lock file, each with its hashes."""
    for block in text.replace("\\\n", " ").splitlines():
        if block.strip() and not block.lstrip().startswith("#"):
            requirement, *hashes = block.split(" --hash=")
            yield Requirement(requirement.strip()), [one.strip() for one in hashes]


def requirements(text: str, packages: tuple[str, ...], python: str) -> list[str]:
    """Lines of a requirements file for the packages, with the hashes of the lock file ``text``.

    Raises UserError for packages that it does not have.
    """
    # pip would ask the markers about the machine that it runs on.
    there = {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "sys_platform": "linux",
        "platform_system": "Linux",
        "platform_machine": "x86_64",
        "implementation_name": "cpython",
        "platform_python_implementation": "CPython",
    }
    found = {
        requirement.name: f"{requirement.name}{requirement.specifier} " + " ".join(f"--hash={one}" for one in hashes)
        for requirement, hashes in locked(text)
        if requirement.marker is None or requirement.marker.evaluate(there)
    }
    if missing := [name for name in packages if name not in found]:
        raise UserError(f"packages: {', '.join(missing)} not in requirements.lock; use names as they are written there")
    return [found[name] for name in packages]


def main(options: Options) -> int:
    """Downloads the wheels, lists them, and returns 1 if they are too large."""
    lines = requirements(LOCK.read_text(), options.packages, options.python)
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "requirements.txt"
        file.write_text("\n".join(lines) + "\n")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        command += ["--only-binary=:all:", "--require-hashes", "--implementation", "cp"]
        command += ["--python-version", options.python, "--dest", str(options.out), "--requirement", str(file)]
        command += [argument for platform in PLATFORMS for argument in ("--platform", platform)]
        if subprocess.run(command).returncode:
            raise UserError("pip could not download the wheels; its message is above")
    sizes = {file.name: file.stat().st_size / 1e6 for file in sorted(options.out.glob("*.whl"))}
    for name, size in sizes.items():
        print(f"{size:7.1f} MB  {name}")
    total = sum(sizes.values())
    print(f"{total:7.1f} MB  together (at most {options.limit_mb:g})")
    return int(total > options.limit_mb)


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
