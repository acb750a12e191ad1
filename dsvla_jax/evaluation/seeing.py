"""Errors on held-out demonstrations, with parts of the observations withheld, as they are kept beside the results."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from dsvla_jax.errors import UserError
from dsvla_jax.files import replacing

FILE = "seeing.json"


@dataclasses.dataclass(frozen=True)
class KeyframeErrors:
    """Medians over demonstrations of one task's keyframe.

    position_cm, rotation_degrees, gripper (the share that is right): of the worse arm. varies_degrees: how far apart
    the demonstrations' own rotations are, the median over pairs.
    """

    task: str
    keyframe: int
    withheld: tuple[str, ...]
    position_cm: float
    rotation_degrees: float
    gripper: float
    varies_degrees: float

    def describe(self) -> str:
        """The errors for people: of the rotation only where the demonstrations' rotations differ."""
        turn = f"; {self.rotation_degrees:.0f}" if self.varies_degrees > 1 else ""
        return f"{self.position_cm:.1f}{turn}"


def name_of(withheld: Sequence[str]) -> str:
    """For people."""
    return "without " + ", ".join(withheld).replace("_", " ") if withheld else "as it is"


def write_errors(folder: Path, digest: str, errors: Sequence[KeyframeErrors]) -> None:
    """Writes the errors of the checkpoint with this digest. The file appears whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / FILE) as partial:
        rows = [dataclasses.asdict(one) for one in errors]
        partial.write_text(json.dumps({"digest": digest, "errors": rows}, indent=1) + "\n")


def read_errors(folder: Path, digest: str) -> list[KeyframeErrors]:
    """The errors in a folder, none if it has none of this checkpoint. Raises UserError for a damaged file."""
    file = folder / FILE
    if not file.exists():
        return []
    try:
        found = json.loads(file.read_text())
        rows = found["errors"] if found["digest"] == digest else []
        return [KeyframeErrors(**{**row, "withheld": tuple(row["withheld"])}) for row in rows]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise UserError(
            f"{file}: not what benchmarks.seeing wrote ({error!r}); delete it, or run that again"
        ) from error
