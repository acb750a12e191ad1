"""Under which conditions an episode was run."""

import dataclasses
import hashlib
import json
from typing import Literal

from dsvla_jax.json_values import Json


@dataclasses.dataclass(frozen=True)
class Conditions:
    """What an episode's outcome depends on besides its task and number. Results of equal conditions are comparable."""

    step: int | None = None
    """Training step of the checkpoint; None in results of versions that did not record it."""
    digest: str = ""
    """Identifies the checkpoint's weights; empty if not recorded."""
    physics: Literal["mujoco", "mjx"] = "mujoco"
    loop: Literal["host", "device"] = "host"
    """Where the closed loop ran."""
    keypoints: str = ""
    """Where keypoints came from; empty if not recorded."""
    keypoint_noise: float = 0.0
    """Metres of uniform noise an axis on every keypoint."""
    shifts: tuple[str, ...] = ()
    """The ways in which test conditions are unlike those of training (paper, Table 4)."""
    seed: int = 0
    """Seed of the stream of episodes."""
    choice: str = "greedy"
    """How integers are chosen from their distributions."""
    image_size: int | None = None
    """Pixels a side of the pictures; None if not recorded."""
    withheld: tuple[str, ...] = ()
    """The parts of its observations that the policy was denied, see `withheld.py`."""

    @property
    def name(self) -> str:
        """A short name for files: what a person knows the conditions by, and a digest of all of them."""
        text = json.dumps(dataclasses.asdict(self), sort_keys=True)
        return f"{self.physics}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"

    def describe(self) -> str:
        """What differs from a plain evaluation, for people."""
        parts = [self.physics]
        if self.loop == "device":
            parts.append("loop on the device")
        if self.keypoint_noise:
            parts.append(f"keypoint noise {self.keypoint_noise:g} m")
        parts += [f"{name} shifted" for name in self.shifts]
        parts += [f"without {name.replace('_', ' ')}" for name in self.withheld]
        if self.choice != "greedy":
            parts.append(self.choice)
        if self.seed:
            parts.append(f"seed {self.seed}")
        return ", ".join(parts)


def conditions_from_json(fields: dict[str, Json]) -> Conditions:
    """Reads what `dataclasses.asdict` wrote as JSON; fields that are missing are those of a plain evaluation.

    Raises TypeError for fields that `Conditions` does not have.
    """
    lists = {name: tuple(value) for name, value in fields.items() if isinstance(value, list)}
    return Conditions(**{**fields, **lists})  # type: ignore[arg-type]
