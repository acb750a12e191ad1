"""The one path from what a robot sees and is told to the inputs of policies that answer with poses."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Float

from dsvla_jax.encoding.past import first_past
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.types import (
    LOOK_BACK,
    Camera,
    NumpyOrJax,
    Past,
    Picture,
    PoseExample,
    PoseInputs,
    RobotState,
    Text,
    library_of,
)

ARMS = 2


def with_two_arms(array: NumpyOrJax, axis: int) -> NumpyOrJax:
    """The array with zeros for the second arm of a robot that has one, along the axis of arms."""
    missing = ARMS - array.shape[axis]
    if not missing:
        return array
    widths = [(0, missing if place == axis else 0) for place in range(array.ndim)]
    return library_of(array).pad(array, widths)


def pose_inputs(
    pictures: Picture[NumpyOrJax],
    robot: RobotState[NumpyOrJax],
    words: Text[NumpyOrJax],
    keypoints: Float[NumpyOrJax, "*b a 3"] | None,
    past: Past[NumpyOrJax] | None,
) -> PoseInputs[NumpyOrJax]:
    """Puts the inputs of one robot, or of a batch of robots with equally many arms, together.

    keypoints: the active one of each arm, metres, world frame, or None. past: None at the beginning of an episode.
    """
    library = library_of(robot.pose)
    *batch, arms, _ = robot.pose.shape
    axis = len(batch)
    state = RobotState(with_two_arms(robot.pose, axis), with_two_arms(robot.gripper_open, axis))
    there: NumpyOrJax = library.broadcast_to(library.arange(ARMS) < arms, (*batch, ARMS))
    near: NumpyOrJax = library.zeros((*batch, ARMS, 3), np.float32)
    if keypoints is not None:
        near = with_two_arms(keypoints, axis)
    has_keypoints: NumpyOrJax = library.full(tuple(batch), keypoints is not None)
    past = first_past(robot) if past is None else past
    before = RobotState(
        with_two_arms(past.robot.pose, axis + 1),
        with_two_arms(past.robot.gripper_open, axis + 1),
    )
    return PoseInputs(pictures, state, there, words, near, has_keypoints, Past(before, past.keyframes))


def encode_instruction(tokenizer: Tokenizer, instruction: str, length: int) -> Text[np.ndarray]:
    """Encodes an instruction on the host, padded to so many tokens. Raises UserError where they are too few."""
    tokens = [tokenizer.bos_id, *tokenizer.encode(instruction)]
    if len(tokens) > length:
        raise UserError(
            f"text: {len(tokens)} tokens are more than max_text_length {length}; raise it, or shorten {instruction!r}"
        )
    padded = np.full(length, tokenizer.pad_id, np.int32)
    padded[: len(tokens)] = tokens
    return Text(padded, np.arange(length) < len(tokens))


def pose_example_spec(
    batch: int, cameras: int, height: int, width: int, words: int, upcoming: int
) -> PoseExample[jax.ShapeDtypeStruct]:
    """The shapes and dtypes of a batch of examples with pictures of (height, width)."""

    def spec(dtype: DTypeLike, *shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((batch, *shape), dtype)

    pictures = Picture(
        spec(jnp.uint8, cameras, height, width, 3),
        spec(jnp.float32, cameras, height, width),
        Camera(spec(jnp.float32, cameras, 3, 3), spec(jnp.float32, cameras, 4, 4)),
    )
    inputs = PoseInputs(
        pictures,
        RobotState(spec(jnp.float32, ARMS, 7), spec(jnp.float32, ARMS)),
        spec(jnp.bool_, ARMS),
        Text(spec(jnp.int32, words), spec(jnp.bool_, words)),
        spec(jnp.float32, ARMS, 3),
        spec(jnp.bool_),
        Past(RobotState(spec(jnp.float32, LOOK_BACK, ARMS, 7), spec(jnp.float32, LOOK_BACK, ARMS)), spec(jnp.int32)),
    )
    return PoseExample(inputs, spec(jnp.float32, upcoming, ARMS, 7), spec(jnp.float32, upcoming, ARMS))
