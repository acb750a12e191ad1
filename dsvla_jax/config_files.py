"""Configs as JSON files: frozen dataclasses in and out."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import cattrs

from dsvla_jax.errors import UserError
from dsvla_jax.json_values import Json

Config = TypeVar("Config")

_converter = cattrs.Converter(forbid_extra_keys=True)


def read_config(file: Path, cls: type[Config], what: str) -> Config:
    """The config that a JSON file of this or an earlier version holds.

    what: what the file should be, for the message. Raises UserError naming the file and what is wrong in it.
    """
    try:
        fields = json.loads(file.read_text())
        if isinstance(fields, dict):
            _rename(fields)
        return _converter.structure(fields, cls)
    except json.JSONDecodeError as error:
        raise UserError(f"{file}: not JSON, or cut short ({error}); put a copy of the file back") from error
    except cattrs.BaseValidationError as error:
        raise UserError(
            f"{file}: not {what} of this version: {'; '.join(_problems(error))}; read it with the version that wrote it"
        ) from error


def _rename(fields: dict[str, Json]) -> None:
    """Turns what earlier versions called otherwise into this version's names."""
    model, learned = fields.get("model"), fields.get("learned_from")
    if isinstance(model, dict) and model.get("attention") == "by_hand":
        model["attention"] = "explicit"
    if isinstance(learned, dict) and "camera" in learned:
        name = learned.pop("camera")
        learned["cameras"] = [name] if name else []


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
