"""Configs as JSON files: frozen dataclasses in and out."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import cattrs

from dsvla_jax.errors import UserError
from dsvla_jax.json_values import Json

Config = TypeVar("Config")

_converter = cattrs.Converter(forbid_extra_keys=True)


def read_config(
    file: Path, cls: type[Config], what: str, upgrade: Callable[[dict[str, Json]], None] | None = None
) -> Config:
    """The config that a JSON file holds. Raises UserError naming the file and what is wrong in it.

    what: what the file should be, for the message. upgrade: turns an earlier version's map into this one's.
    """
    try:
        fields = json.loads(file.read_text())
        if upgrade is not None and isinstance(fields, dict):
            upgrade(fields)
        return _converter.structure(fields, cls)
    except (json.JSONDecodeError, cattrs.BaseValidationError) as error:
        raise UserError(f"{file}: not {what} of this version: {'; '.join(_problems(error))}") from error


def _problems(error: Exception) -> Iterator[str]:
    """What is wrong: the messages of configs that refused their values, and what does not fit their fields."""
    refused = list(_refusals(error))
    if refused or not isinstance(error, cattrs.BaseValidationError):
        yield from refused or [str(error)]
    else:
        yield from cattrs.transform_error(error)


def _refusals(error: object) -> Iterator[str]:
    if isinstance(error, UserError):
        yield str(error)
    for part in getattr(error, "exceptions", ()):
        yield from _refusals(part)
