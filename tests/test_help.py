"""Every option of every program says what it does."""

import contextlib
import importlib
import importlib.util
import re
import runpy
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import tyro

# Configs that have optional parts, and commands that have options of their own.
PROGRAMS = (
    *("train tiny", "train tiny_lora", "train tiny_oxe", "train paper_7b", "eval"),
    *("dsvla_jax.weights import", "dsvla_jax.weights export", "dsvla_jax.serving", "dsvla_jax.evaluation.demo"),
    *("plan paper_7b", "data_pipelines.demos", "data_pipelines.find_keypoints"),
    *("data_pipelines.inspect", "data_pipelines.rlbench", "data_pipelines.vocabulary"),
    *("data_pipelines.oxe list", "data_pipelines.oxe prepare", "data_pipelines.oxe vocabulary"),
    "data_pipelines.oxe fixtures",
)
# What tyro itself adds to the text of an option.
_NOTES = re.compile(r"\s*\((default|required|repeatable|sets|fixed)[^)]*\)*.*", re.DOTALL)


class _Captured(Exception):
    """A program has said what its options are."""


@contextlib.contextmanager
def captured() -> Iterator[list[tuple[Any, dict[str, Any]]]]:
    """Ends every program where it would parse its options, and keeps what it would parse them with."""
    found: list[tuple[Any, dict[str, Any]]] = []
    cli, commands = tyro.cli, tyro.extras.subcommand_cli_from_dict

    def keep(options: Any, **settings: Any) -> None:
        found.append((options, settings))
        raise _Captured

    def keep_command(functions: dict[str, Callable[..., Any]], **settings: Any) -> None:
        keep(functions[sys.argv[1]], **settings)

    arguments = sys.argv
    try:
        tyro.cli, tyro.extras.subcommand_cli_from_dict = keep, keep_command  # type: ignore[assignment]
        yield found
    finally:
        tyro.cli, tyro.extras.subcommand_cli_from_dict = cli, commands
        sys.argv = arguments


def _is_package(name: str) -> bool:
    spec = importlib.util.find_spec(name)
    return spec is not None and spec.submodule_search_locations is not None


def options_of(program: str) -> dict[str, str]:
    """The help text of each option, without the notes that tyro adds."""
    name, *command = program.split()
    module = importlib.import_module(f"{name}.__main__" if _is_package(name) else name)
    with captured() as found, contextlib.suppress(_Captured), warnings.catch_warnings():
        # That a module that runs has been imported before.
        warnings.simplefilter("ignore", RuntimeWarning)
        sys.argv = [name, *command, "--help"]
        if hasattr(module, "command_line"):
            module.command_line(sys.argv[1:])
        else:
            runpy.run_module(module.__name__, run_name="__main__")
    ((options, settings),) = found
    # Help is read from the source of the module that is imported, which a module that runs is not.
    options = getattr(module, options.__name__, options)
    settings.pop("args", None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(options, **settings)
    return {
        "/".join(action.option_strings) or str(action.metavar): _NOTES.sub("", str(action.help))
        for action in parser._actions
        if "--help" not in action.option_strings
    }


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_option_has_help_text(program: str):
    options = options_of(program)
    assert options
    assert not [name for name, text in options.items() if not text.strip()]
