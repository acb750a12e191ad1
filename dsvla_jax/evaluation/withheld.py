"""A policy that is denied a part of what it looks at: how much of its success does it owe to that part?"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np

from dsvla_jax.errors import UserError
from dsvla_jax.types import Action, Observation, Picture

Act = Callable[[Observation, Sequence[str], np.ndarray | None], tuple[Action, Sequence[str]]]
"""`Policy.act`."""

Part = Literal["colour", "depth", "keypoint", "own_pictures"]
PARTS: tuple[Part, ...] = get_args(Part)

GREY = 128


def check_parts(parts: Sequence[str]) -> tuple[Part, ...]:
    """The parts in the order of `PARTS`, none twice. Raises UserError for one that there is not."""
    if unknown := [part for part in parts if part not in PARTS]:
        raise UserError(f"withhold: expected {', '.join(PARTS)}, got {', '.join(unknown)}")
    return tuple(part for part in PARTS if part in parts)


def withholding(act: Act, parts: Sequence[Part]) -> Act:
    """The policy without parts of its observations.

    colour: pictures are grey all over. depth: no pixel has a reading, so there is no point cloud. keypoint: prompts
    do not state one. own_pictures: every episode gets the pictures of the one half a batch further on, while robot,
    instruction and keypoints stay its own.
    """

    def without(
        observation: Observation, instructions: Sequence[str], keypoints: np.ndarray | None
    ) -> tuple[Action, Sequence[str]]:
        denied = dataclasses.replace(observation, pictures=_withhold(observation.pictures, parts))
        return act(denied, instructions, None if "keypoint" in parts else keypoints)

    return without if parts else act


def _withhold(pictures: Picture, parts: Sequence[Part]) -> Picture:
    rgb, depth, camera = np.asarray(pictures.rgb), np.asarray(pictures.depth), pictures.camera
    if "own_pictures" in parts:
        if len(rgb) < 2:
            raise UserError("withhold: own_pictures needs another episode beside each; raise --episodes or --batch")
        rgb, depth = (np.roll(x, len(x) // 2, axis=0) for x in (rgb, depth))
    if "colour" in parts:
        rgb = np.full_like(rgb, GREY)
    if "depth" in parts:
        depth = np.zeros_like(depth)
    return Picture(rgb, depth, camera)
