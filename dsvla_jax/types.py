"""Core data types, and the conventions for array dimensions used throughout.

An array dimension has one letter everywhere:

    b  batch of examples or of parallel episodes      t  text tokens
    a  arms (1 or 2; the left arm first)              v  vocabulary
    c  cameras (1 to 4), in the order of their names
    h, w  image height and width, pixels              d  feature channels
    p  points of a cloud                              g  3D tokens (groups); also FPS centres
    n  2D image patches                               k  neighbours, or keypoints where no cloud is near
    l  answer tokens                                  s  side of the square image the network sees, pixels
    u  upcoming keyframes                             m  moments that are looked back on

Docstrings write them in capitals. A struct holds one item or a batch: `*b` stands for any number of leading axes, the
same for all its fields. The structs are generic in the array type: `Example[np.ndarray]` on the host,
`Example[jax.Array]` in a traced function, `Example[jax.ShapeDtypeStruct]` for shapes alone.

Lengths are metres, angles radians, images row-major. The world frame has z up and the table top at z = 0.752, as in
RLBench. A pose is [x, y, z, qx, qy, qz, qw] of the end-effector (the tool centre point between the finger tips) in
the world frame. Quaternions are xyzw, unit length, canonical (qw >= 0). `gripper_open` is 1 for open, 0 for closed.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from types import ModuleType
from typing import Generic, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

Array = jax.Array

ArrayT = TypeVar("ArrayT", jax.Array, np.ndarray, jax.ShapeDtypeStruct)
"""The type of a struct's arrays."""

TABLE_HEIGHT = 0.752
LOOK_BACK = 4
"""M: the states that a `Past` holds."""

T = TypeVar("T")


@dataclass_transform(frozen_default=True)
def pytree(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass that is a pytree of its fields.

    JAX rebuilds pytrees of placeholders, which are no arrays: the rebuilt object skips `__init__`, and with it the
    shape checks that the tests switch on (JAX documentation, "Custom pytrees and initialization").
    """
    made: type[T] = dataclasses.dataclass(frozen=True)(cls)
    names = tuple(field.name for field in dataclasses.fields(made))  # pyright: ignore[reportArgumentType]

    def flatten(value: T) -> tuple[tuple[object, ...], None]:
        return tuple(getattr(value, name) for name in names), None

    def flatten_with_keys(value: T) -> tuple[tuple[tuple[object, object], ...], None]:
        return tuple((jax.tree_util.GetAttrKey(name), getattr(value, name)) for name in names), None

    def unflatten(_: None, children: Iterable[object]) -> T:
        value = object.__new__(made)
        for name, child in zip(names, children, strict=True):
            object.__setattr__(value, name, child)
        return value

    jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
    return made


def named_arrays(tree: object) -> dict[str, Array | np.ndarray]:
    """Returns the arrays of a struct by their paths, such as `pictures.camera.intrinsics`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


@pytree
class Camera(Generic[ArrayT]):
    """A pinhole camera in the RLBench/PyRep convention."""

    intrinsics: Float[ArrayT, "*b 3 3"]
    """float32. The focal lengths are negative for RLBench's cameras, and are never made positive:
    u = fx X / Z + cx, v = fy Y / Z + cy for a point (X, Y, Z) in the camera frame, Z > 0 in front."""
    world_from_camera: Float[ArrayT, "*b 4 4"]
    """float32, camera-to-world."""


@pytree
class Picture(Generic[ArrayT]):
    """One RGB-D picture and the camera that took it, or a stack of them."""

    rgb: UInt8[ArrayT, "*b h w 3"]
    depth: Float[ArrayT, "*b dh dw"]
    """float32, planar Z in metres; 0 or a non-finite value marks a missing reading. As large as `rgb`, or one missing
    pixel (1, 1) for data without depth."""
    camera: Camera[ArrayT]


def split_cameras(pictures: Picture[np.ndarray]) -> list[Picture[np.ndarray]]:
    """Returns the pictures of one moment, stacked on a camera axis in front, one by one."""
    return [jax.tree.map(lambda x, c=c: x[c], pictures) for c in range(len(pictures.rgb))]


def join_cameras(pictures: Sequence[Picture[np.ndarray]]) -> Picture[np.ndarray]:
    """The inverse of `split_cameras`."""
    return jax.tree.map(lambda *arrays: np.stack(arrays), *pictures)


@pytree
class RobotState(Generic[ArrayT]):
    """The robot's own reading of its arms."""

    pose: Float[ArrayT, "*b a 7"]
    gripper_open: Float[ArrayT, "*b a"]


@pytree
class Past(Generic[ArrayT]):
    """What an episode has been before the present observation."""

    robot: RobotState[ArrayT]
    """The states (*b, m, a, 7) before each of the last keyframes, the oldest first; an episode's first state stands for
    those before it."""
    keyframes: Int[ArrayT, "*b"]
    """int32: how many were executed."""


@pytree
class Observation(Generic[ArrayT]):
    """What a policy may look at: pictures, the robot's state, and what has been."""

    pictures: Picture[ArrayT]
    """One of each camera: rgb (*b, c, h, w, 3), and so on. All have one size."""
    robot: RobotState[ArrayT]
    past: Past[ArrayT] | None = None
    """None where nobody kept it: as at the beginning of an episode."""


@pytree
class Action(Generic[ArrayT]):
    """The next keyframe. The gripper moves once the pose is reached."""

    pose: Float[ArrayT, "*b a 7"]
    gripper_open: Float[ArrayT, "*b a"]
    """0 or 1."""


@pytree
class Text(Generic[ArrayT]):
    """Token sequences, padded at the end."""

    tokens: Int[ArrayT, "*b t"]
    """int32: beginning-of-sequence, prompt [, answer, end-of-sequence], padding."""
    mask: Bool[ArrayT, "*b t"]
    """False on padding."""


@pytree
class Example(Generic[ArrayT]):
    """What a policy learns from: pictures, and prompt and answer as text."""

    pictures: Picture[ArrayT]
    """One of each camera, as of an `Observation`."""
    text: Text[ArrayT]
    answer_mask: Bool[ArrayT, "*b t"]
    """True on the tokens to learn: the answer's, and its end."""
    number_rows: Int[ArrayT, "*b t"]
    """int32: on tokens that choose a bin of position or rotation, which choice it is (`encoding.number_targets`);
    0 elsewhere."""


@pytree
class HeldOutExample(Generic[ArrayT]):
    """An example with the integers of its answer, for comparison with a policy's."""

    example: Example[ArrayT]
    integers: Int[ArrayT, "*b 2 8"]
    """int32: the answer's; zeros for a second arm that is not there."""
    number_of: Int[ArrayT, "*b t"]
    """int32: which of the integers, counted from 1, a token belongs to; 0 for none."""


@pytree
class PoseInputs(Generic[ArrayT]):
    """What a policy reads that answers with poses: all robots have two arms here, of which one may be missing."""

    pictures: Picture[ArrayT]
    """One of each camera, as of an `Observation`."""
    robot: RobotState[ArrayT]
    """Of two arms; a missing one's is zeros."""
    arms: Bool[ArrayT, "*b 2"]
    """Which arms are there."""
    words: Text[ArrayT]
    """The instruction."""
    keypoints: Float[ArrayT, "*b 2 3"]
    """The active one of each arm, metres, world frame; zeros where none is known."""
    has_keypoints: Bool[ArrayT, "*b"]
    past: Past[ArrayT]
    """Of two arms, as `robot`."""


@pytree
class PoseExample(Generic[ArrayT]):
    """What such a policy learns from: its inputs, and the keyframes that follow."""

    inputs: PoseInputs[ArrayT]
    pose: Float[ArrayT, "*b u 2 7"]
    """Of the next keyframes in order, the last repeated; zeros for a missing arm."""
    gripper_open: Float[ArrayT, "*b u 2"]
    """0 or 1."""


@pytree
class ModelInputs(Generic[ArrayT]):
    """What the network reads. `encoding.encode.model_inputs` makes it."""

    images: Float[ArrayT, "*b c s s 3"]
    """float32, one of each camera, normalised as CLIP's."""
    point_tokens: Float[ArrayT, "*b g d"]
    """float32, from the 3D tokenizer; G = 0 for a policy without 3D input."""
    point_patches: Int[ArrayT, "*b g"]
    """int32: camera * N + patch: the image patch (row-major) that a 3D token is aligned with, and whose positional
    embedding it carries."""
    text: Text[ArrayT]


NumpyOrJax = TypeVar("NumpyOrJax", np.ndarray, jax.Array)
"""The arrays of one library: what a function of both is given and returns."""


def library_of(array: object) -> ModuleType:
    """numpy for its own arrays, jax.numpy for all else."""
    return np if isinstance(array, np.ndarray) else jnp
