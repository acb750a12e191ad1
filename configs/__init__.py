"""Experiments, one a file. Each module has a function ``config() -> Experiment``."""

import difflib
import importlib
import importlib.util
import pkgutil
import sys
from pathlib import Path
from types import ModuleType

from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment


def config_names() -> list[str]:
    """Returns the names of this package's experiments."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def get_config(name: str) -> Experiment:
    """Returns the experiment of a config.

    name: one of `config_names()`, ``configs/NAME.py`` from any folder, or the path of a Python file of your own. The
    file is executed. Raises UserError, with the nearest name, if there is no such config or it returns no experiment.
    """
    module = config_module(name)
    function = getattr(module, "config", None)
    if not callable(function):
        raise UserError(f"{name}: no function config() in this file; define config() -> Experiment, as configs/tiny.py")
    experiment = function()
    if not isinstance(experiment, Experiment):
        raise UserError(f"{name}: config() must return an Experiment, got {type(experiment).__name__}")
    return experiment


def config_module(name: str) -> ModuleType:
    """Imports the module of a config: a file at that path, or else the package's own of that name."""
    path = Path(name)
    names = config_names()
    if path.suffix == ".py" and path.is_file():
        return module_at(path)
    short = name.removeprefix("configs/").removesuffix(".py")
    if short in names:
        return importlib.import_module(f"configs.{short}")
    near = difflib.get_close_matches(path.stem, names, 1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    missing = "no such file; " if path.suffix == ".py" else ""
    raise UserError(
        f"unknown config {name!r}: {missing}{hint}expected the path of a Python file with a function config(), or one "
        f"of: {', '.join(names)}"
    )


def module_at(path: Path) -> ModuleType:
    """Executes a Python file as a module of its own."""
    path = path.resolve()
    if Path(__file__).parent == path.parent:
        return importlib.import_module(f"configs.{path.stem}")
    name = f"_config_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look up their own module there.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
