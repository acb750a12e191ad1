"""What datasets share: where they are published, the layouts of their steps, and doubts about them.

Two layouts are common. Datasets of Open X-Embodiment's first release keep actions in named fields; those that others
converted to RLDS have one action vector and one state vector.
"""

from typing import Literal, TypedDict, Unpack

from data_pipelines.oxe.columns import Column, Delta, Join, Openness, Pose, Read, RotationKind
from data_pipelines.oxe.dataset import ArmColumns, Depth, Encoding, OxeDataset, View

BUCKET = "gs://gresearch/robotics"
SUFFIX = "_converted_externally_to_rlds"
FRANKA_WIDTH = 0.08
"""Metres between the fingers of an open Franka hand."""

IMAGE: dict[View, str] = {"primary": "image"}
IMAGE_AND_WRIST: dict[View, str] = {"primary": "image", "wrist": "wrist_image"}
EXCHANGED_VIEWS: tuple[View, ...] = ("primary", "wrist")

EXCHANGED = "red and blue are exchanged in all pictures"
SCALED = "actions are scaled to -1..1: only reached poses are metric"
JOINTS_ONLY = "joints only, no pose of the hand: this model cannot learn from it"
OPENING_DOUBTED = "unsure: thu-ml/RoboticsDiffusionTransformer takes 1 for closed, octo and openvla for open, as here"
QUATERNION_DOUBTED = "unsure: the order of the quaternion is not published"
UNCLEAR_ACTION = "whether the action is a pose or a displacement is unclear: displacements come from reached poses"

LANGUAGE = "observation/natural_language_instruction"
"""Where the first release keeps the instruction."""
WORLD_VECTOR, CLOSING_ACTION = Read("action/world_vector"), Read("action/gripper_closedness_action")


def moved(hz: float | None = None) -> Column:
    """world_vector and rotation_delta; velocities, whose rotation is a vector, if a frequency is given."""
    scale = 1.0 / hz if hz else 1.0
    return Delta(Join(WORLD_VECTOR, Read("action/rotation_delta")), "rotvec" if hz else "rpy", scale, scale)


class Options(TypedDict, total=False):
    """Further fields of an OxeDataset."""

    bgr: tuple[View, ...]
    encoding: Encoding
    metric: bool
    frame: Literal["base", "tool"]
    depth: Depth | None
    first: int
    stride: int


def converted(
    name: str,
    hz: float,
    images: dict[View, str],
    *arms: ArmColumns,
    notes: tuple[str, ...] = (),
    published: str = "0.1.0",
    **options: Unpack[Options],
) -> OxeDataset:
    """A converted dataset that is in the bucket under its own name. published: its version there."""
    source = f"{BUCKET}/{name}/{published}"
    return OxeDataset(name, hz, source, images, arms, notes=notes, **options)


def closing(stop: int) -> Column:
    """A command of -1 or 0 for open and 1 for closed in the column before `stop`."""
    return Openness(Read("action", stop - 1, stop), 1, 0)


def opening(start: int) -> Column:
    """A command of 0 for closed and 1 for open."""
    return Openness(Read("action", start, start + 1), 0, 1)


def reached(
    name: str,
    hz: float,
    rotation: RotationKind,
    gripper_state: Column | None = None,
    gripper: Column | None = None,
    state: str = "observation/state",
    scale: float = 1.0,
    images: dict[View, str] = IMAGE,
    notes: tuple[str, ...] = (),
) -> OxeDataset:
    """A converted dataset with one arm, whose pose is the first six columns of the state: `scale` metres, radians.

    Its page leaves open whether the action is a pose or a displacement, so the action is left out.
    """
    gripper = opening(6) if gripper is None else gripper
    arm = ArmColumns(gripper=gripper, pose=Pose(Read(state, 0, 6), rotation, scale), gripper_state=gripper_state)
    return converted(name, hz, images, arm, notes=(UNCLEAR_ACTION, *notes))
