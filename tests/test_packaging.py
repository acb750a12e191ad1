"""What is installed is whole: nothing that the installed code needs is left to the development environment."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

from benchmarks.install import PACKAGES

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
INSTALLED = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["only-include"]
# Packages that an extra installs, imported where they are used.
EXTRAS = PROJECT["project"]["optional-dependencies"]
OPTIONAL = ("gguf", "libtpu", "torch", "transformers", "wandb")


def normalized(requirement: str) -> str:
    """The name in a requirement, as indexes spell it."""
    return re.sub(r"[-_.]+", "-", re.split(r"[<>=!~; \[]", requirement)[0]).lower()


def installed_files() -> list[Path]:
    files = [ROOT / name for name in INSTALLED if name.endswith(".py")]
    return files + [file for name in INSTALLED for file in (ROOT / name).rglob("*.py")]


def imported_names(file: Path) -> set[str]:
    """The top-level names that a file imports, also within functions."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(str(node.module).split(".")[0])
    return names


def test_everything_that_installed_code_imports_is_installed_with_it():
    own = {Path(name).stem for name in INSTALLED}
    assert own >= set(PACKAGES)
    declared = {normalized(requirement) for requirement in PROJECT["project"]["dependencies"]}
    of_extras = {normalized(name) for extra, names in EXTRAS.items() if extra != "dev" for name in names}
    assert of_extras >= set(OPTIONAL)
    distributions = packages_distributions()
    undeclared = {}
    for file in installed_files():
        for name in imported_names(file) - own - sys.stdlib_module_names - set(OPTIONAL):
            if not {normalized(one) for one in distributions.get(name, ())} & declared:
                undeclared.setdefault(name, file.relative_to(ROOT).as_posix())
    assert not undeclared


def test_every_folder_of_the_packages_is_a_package():
    folders = {file.parent for name in PACKAGES for file in (ROOT / name).rglob("*.py")}
    assert not [folder for folder in folders if not (folder / "__init__.py").exists()]
    # What git ignores is left out of a wheel.
    data = [file for name in PACKAGES for file in (ROOT / name).rglob("*") if file.suffix in (".jinja", ".typed")]
    assert len(data) >= 6
    ignored = subprocess.run(["git", "check-ignore", "--no-index", *data], cwd=ROOT, capture_output=True, text=True)
    assert ignored.stdout == ""


def test_the_named_programs_exist():
    for target in PROJECT["project"]["scripts"].values():
        module, function = target.split(":")
        defined = ast.parse((ROOT / f"{module}.py").read_text()).body
        assert function in {node.name for node in defined if isinstance(node, ast.FunctionDef)}


def test_no_message_sends_users_to_an_index_that_lacks_the_project():
    files = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "benchmarks").glob("*.py"), *installed_files()]
    assert not [file.name for file in files if re.search(r"install .{0,9}dsvla[-_]jax\[", file.read_text())]


def test_the_lock_has_every_requirement_and_the_development_tools():
    locked = {normalized(line) for line in (ROOT / "requirements.lock").read_text().splitlines() if "==" in line}
    required = [*PROJECT["project"]["dependencies"], *EXTRAS["dev"]]
    assert not {normalized(requirement) for requirement in required} - locked
