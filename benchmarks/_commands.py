"""The commands that README and docs show: finds them, and has each program parse its options without running."""

import argparse
import contextlib
import dataclasses
import functools
import importlib.util
import inspect
import io
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import tyro

ROOT = Path(__file__).parent.parent
# What a command begins with, for those that stand between backquotes or in an indented block.
BEGINNINGS = r"(?:python|make|pip|uv|sbatch|kubectl|gsutil) "


@dataclasses.dataclass(frozen=True)
class Command:
    """A command of a page."""

    page: str
    """Relative to the repository."""
    line: int
    """The first is 1."""
    text: str
    """As written, without comments; several lines if the shell needs them as one."""
    block: bool
    """Whether it stands in an ```sh block, not in a sentence."""

    @property
    def only_names(self) -> bool:
        """Whether a sentence names a program (and one of its commands) without saying how to call it."""
        return not self.block and re.fullmatch(r"python -m [\w.]+( [a-z]+)?", self.text) is not None

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"


def pages(root: Path = ROOT) -> list[Path]:
    """Returns README.md and the pages of docs/, in the order in which a new user meets them."""
    return [root / "README.md", *sorted((root / "docs").glob("*.md"))]


def find_commands(page: Path, root: Path = ROOT) -> list[Command]:
    """Returns the commands of a page in its order: those of ```sh blocks, and those between backquotes in sentences."""
    name, text = page.relative_to(root).as_posix(), page.read_text()
    commands = []
    blocks = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
    for match in blocks.finditer(text):
        if match[1] == "sh":
            line = text.count("\n", 0, match.start()) + 2
            commands += [Command(name, line + i, command, True) for i, command in split_block(match[2])]
    sentences = blocks.sub(lambda match: "\n" * match[0].count("\n"), text)
    for match in re.finditer(rf"`({BEGINNINGS}(?!-m`)[^`]+)`", sentences):
        line = sentences.count("\n", 0, match.start()) + 1
        commands.append(Command(name, line, " ".join(match[1].split()), False))
    return sorted(commands, key=lambda command: command.line)


def example_files(page: Path) -> dict[str, str]:
    """Returns the programs that a page shows, ```python blocks whose first line is a comment with a path, by path."""
    blocks = re.findall(r"^```python\n(# (\S+\.py)\n.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)
    return {path: text for text, path in blocks}


def indented_commands(page: Path) -> list[str]:
    """Returns the lines of a page that are commands outside of ```sh blocks, where nothing would run them."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    return re.findall(rf"^    (?:\S+=\S+ )*{BEGINNINGS}.*$", text, re.MULTILINE)


def split_block(block: str) -> Iterator[tuple[int, str]]:
    """Yields the complete commands of a shell block and the number of the line, from 0, that each begins in.

    A loop is one command, and an assignment is one with the command after it.
    """
    begun, start = "", 0
    for number, line in enumerate(block.splitlines()):
        line = without_comment(line)
        if not line and not begun:
            continue
        start = start if begun else number
        begun += f"\n{line}" if begun else line
        unfinished = begun.endswith("\\") or re.fullmatch(r"\w+=(?! ).*", line)
        if not unfinished and subprocess.run(["bash", "-n", "-c", begun], capture_output=True).returncode == 0:
            yield start, begun
            begun = ""
    if begun:
        yield start, begun


def without_comment(line: str) -> str:
    """Returns a line of shell without its comment, which a # within quotes does not begin."""
    for match in re.finditer(r"(^|\s)#", line):
        before = line[: match.start()]
        if before.count('"') % 2 == before.count("'") % 2 == 0:
            return before.rstrip()
    return line.rstrip()


def problem_with(command: Command) -> str | None:
    """Returns what a command does wrong that can be known without running it; None if nothing.

    Python programs parse their options; make's targets, files and the extras of an installation must exist. Files of
    the user's own are looked for in the working directory.
    """
    text = f"{command.text} --help" if command.only_names else command.text
    words = shlex.split(text.splitlines()[-1] if re.match(r"\w+=", text) else text)
    match words:
        case ["make", *targets]:
            known = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
            unknown = [word for word in targets if "=" not in word and word not in known]
            return f"make has no target {unknown[0]}" if unknown else None
        case ["pip", "install", *packages]:
            return problem_with_packages(packages)
        case ["sbatch", file, *_] | ["kubectl", "apply", "-f", file]:
            return None if (ROOT / file).exists() else f"no file {file}"
    programs = re.findall(r"(?:^|\s)python ([^\n;&|]+)", text)
    # An assignment may ask python for a value.
    problems = [problem_with_program(shlex.split(program)) for program in programs if not program.startswith("-c")]
    return next((problem for problem in problems if problem), None)


def problem_with_packages(packages: list[str]) -> str | None:
    """Returns the first extra that pyproject.toml does not have, or package of this name, which no index has."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for package in packages:
        if package.startswith("dsvla") and "@ git+" not in package:
            return f"{package} is on no index: install from a clone, as in pip install -e ."
        if extra := re.fullmatch(r"\.\[(.*)\]", package):
            missing = [name for name in extra[1].split(",") if name not in extras]
            if missing:
                return f"no extra {missing[0]}"
    return None


class _Parsed(Exception):
    """A program has parsed its options."""


def problem_with_program(words: list[str]) -> str | None:
    """Returns what `python WORDS` says of its options; None if they are right, or are another project's."""
    module = words[1] if words[0] == "-m" else ""
    arguments = words[2:] if module else words[1:]
    if module == "pytest":
        return None
    file = module_file(module) if module else ROOT / words[0] if (ROOT / words[0]).exists() else Path(words[0])
    if file is None or not file.exists():
        return f"no program {module or words[0]}"
    source = file.read_text()
    if not re.search(r"tyro\.cli\(|parse_options\(|subcommand_cli|parse_args\(", source):
        option = next((word for word in arguments if word.startswith("-") and word != "--help"), None)
        return f"{module} has no option {option}" if option else None
    output = io.StringIO()
    try:
        with only_parsing(), contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            sys.argv = [str(file), *arguments]
            if module:
                runpy.run_module(module, run_name="__main__", alter_sys=True)
            else:
                runpy.run_path(str(file), run_name="__main__")
    except _Parsed:
        return None
    except SystemExit as status:
        return None if status.code in (0, None) else output.getvalue().strip() or f"status {status.code}"
    return "it did not parse its options"


def module_file(module: str) -> Path | None:
    """Returns the file that `python -m MODULE` runs."""
    try:
        spec = importlib.util.find_spec(module)
        if spec is not None and spec.submodule_search_locations is not None:
            spec = importlib.util.find_spec(f"{module}.__main__")
    except ModuleNotFoundError:
        return None
    return Path(spec.origin) if spec is not None and spec.origin else None


@contextlib.contextmanager
def only_parsing() -> Iterator[None]:
    """Ends every program with _Parsed as soon as its parser is content."""

    def instead(function: Callable[..., Any]) -> Callable[..., Any]:
        def stop(*_: Any, **__: Any) -> None:
            raise _Parsed

        return functools.wraps(function)(stop) if inspect.isfunction(function) else function

    cli, commands, parse = tyro.cli, tyro.extras.subcommand_cli_from_dict, argparse.ArgumentParser.parse_args
    arguments, path = sys.argv, list(sys.path)

    def parse_args(parser: argparse.ArgumentParser, *args: Any, **kwargs: Any) -> None:
        parse(parser, *args, **kwargs)
        raise _Parsed

    def tyro_cli(function: Callable[..., Any], *args: Any, **kwargs: Any) -> None:
        cli(instead(function), *args, **kwargs)
        raise _Parsed

    def tyro_commands(functions: dict[str, Callable[..., Any]], *args: Any, **kwargs: Any) -> None:
        commands({name: instead(function) for name, function in functions.items()}, *args, **kwargs)
        raise _Parsed

    try:
        tyro.cli, tyro.extras.subcommand_cli_from_dict = tyro_cli, tyro_commands  # type: ignore[assignment]
        argparse.ArgumentParser.parse_args = parse_args  # type: ignore[assignment,method-assign]
        with warnings.catch_warnings():
            # That a module that runs has been imported before.
            warnings.simplefilter("ignore", RuntimeWarning)
            yield
    finally:
        tyro.cli, tyro.extras.subcommand_cli_from_dict = cli, commands
        argparse.ArgumentParser.parse_args = parse  # type: ignore[method-assign]
        sys.argv, sys.path[:] = arguments, path
