"""Experiments, one a file. Each module has a function ``config() -> Experiment``."""

import difflib
import importlib
import pkgutil

from dsvla_jax.errors import UserError
from dsvla_jax.training.experiment import Experiment


def config_names() -> list[str]:
    """The experiments there are."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def get_config(name: str) -> Experiment:
    """The experiment of ``configs/{name}.py``; raises UserError with the nearest name where there is none."""
    name = name.removeprefix("configs/").removesuffix(".py")
    names = config_names()
    if name not in names:
        near = difflib.get_close_matches(name, names, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise UserError(f"unknown config {name!r}: {hint}configs/ has: {', '.join(names)}")
    return importlib.import_module(f"configs.{name}").config()
