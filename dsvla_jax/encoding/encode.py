"""The one path from pictures and words to the network's inputs."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Bool, Float, Int

from dsvla_jax.encoding.alignment import align_to_patches
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.farthest_point import farthest_point_sample
from dsvla_jax.encoding.grammar import tokenize_answer
from dsvla_jax.encoding.point_cloud import joint_cloud
from dsvla_jax.encoding.point_tokens import tokenize_points
from dsvla_jax.encoding.prompts import format_prompt
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.types import Array, Camera, Example, ModelInputs, Picture, RobotState, Text

# The normalisation CLIP was trained with (https://github.com/openai/CLIP).
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


def model_inputs(pictures: Picture[Array], text: Text[Array], config: EncodingConfig) -> ModelInputs[Array]:
    """Encodes a batch of pictures and texts for the network. Pictures may have any size; their cameras describe it.

    pictures: rgb (B, C, H, W, 3), and so on.
    """
    batch, cameras = pictures.rgb.shape[:2]
    images = normalize_image(pictures.rgb.reshape(-1, *pictures.rgb.shape[2:]), config.image_size)
    if not config.use_images:
        images = jnp.zeros_like(images)
    if config.use_points:
        tokens, _, patches = cloud_tokens(pictures, config)
    else:
        tokens = jnp.zeros((batch, 0, config.points.width), jnp.float32)
        patches = jnp.zeros((batch, 0), jnp.int32)
    return ModelInputs(images.reshape(batch, cameras, *images.shape[1:]), tokens, patches, text)


def cloud_tokens(
    pictures: Picture[Array], config: EncodingConfig
) -> tuple[Float[Array, "b g d"], Float[Array, "b g 3"], Int[Array, "b g"]]:
    """Makes the 3D tokens of a batch, of the joint cloud of all its cameras.

    Returns the tokens, their centres (metres, world frame), and the image patches that they are aligned with: each
    with a patch of the camera that its centre comes from.
    """
    cameras, height, width = pictures.depth.shape[1:]
    points, valid = joint_cloud(pictures, config)
    of_a_camera = points.shape[1] // cameras
    chosen = farthest_point_sample(points, valid, config.points.num_points)
    points = jnp.take_along_axis(points, chosen[..., None], axis=1)
    tokens, centers = jax.vmap(lambda one: tokenize_points(one, config.points))(points)
    # A token's centre is one of the points: the first ones, see `tokenize_points`.
    seen_by = chosen[:, : config.points.num_tokens] // of_a_camera
    align = jax.vmap(
        lambda centers, seen_by, cameras: align_to_patches(
            centers, seen_by, cameras, height, width, config.grid, config.alignment
        )
    )
    patches = align(centers, seen_by, pictures.camera)
    return tokens, centers, patches


def example_spec(
    config: EncodingConfig, batch: int, cameras: int, height: int, width: int
) -> Example[jax.ShapeDtypeStruct]:
    """The shapes and dtypes of a batch of examples with pictures of (height, width)."""

    def spec(dtype: DTypeLike, *shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((batch, *shape), dtype)

    length = config.max_text_length
    return Example(
        Picture(
            spec(jnp.uint8, cameras, height, width, 3),
            spec(jnp.float32, cameras, height, width),
            Camera(spec(jnp.float32, cameras, 3, 3), spec(jnp.float32, cameras, 4, 4)),
        ),
        Text(spec(jnp.int32, length), spec(jnp.bool_, length)),
        answer_mask=spec(jnp.bool_, length),
        number_rows=spec(jnp.int32, length),
    )


def normalize_image(rgb: ArrayLike, size: int) -> Array:
    """uint8 (B, H, W, 3) -> float32 (B, size, size, 3): bicubic resize where the size differs, then CLIP's scaling."""
    rgb = jnp.asarray(rgb)
    if rgb.ndim != 4 or rgb.shape[-1] != 3 or rgb.dtype != jnp.uint8:
        raise ValueError(f"rgb: expected a batch of uint8 images (B, H, W, 3), got {rgb.dtype} {rgb.shape}")
    image = rgb.astype(jnp.float32) / 255.0
    if image.shape[1:3] != (size, size):
        image = jnp.clip(jax.image.resize(image, (image.shape[0], size, size, 3), "bicubic"), 0.0, 1.0)
    return (image - jnp.array(CLIP_MEAN, jnp.float32)) / jnp.array(CLIP_STD, jnp.float32)


def build_prompt(
    config: EncodingConfig,
    instruction: str,
    robot: RobotState[np.ndarray],
    keypoints: Float[np.ndarray, "a 3"] | None,
) -> str:
    """Writes the question of one step, on the host.

    keypoints: metres, world frame: the active keypoint of each arm, or None if there is none.
    """
    state = config.codec.encode(robot.pose, robot.gripper_open)
    integers = None
    if config.use_keypoints and keypoints is not None:
        integers = config.codec.encode_position(np.asarray(keypoints))
    return format_prompt(instruction, state, integers, config.style)


def encode_text(
    tokenizer: Tokenizer, prompt: str, answer: str | None, max_length: int
) -> tuple[Text[np.ndarray], Bool[np.ndarray, " t"]]:
    """Encodes a prompt and its answer as padded tokens, on the host.

    The prompt's tokens do not depend on its answer; raises UserError if the tokenizer would make them.

    Args:
        answer: None at inference; then the text ends with the prompt, without the end-of-sequence token.

    Returns:
        The text, and a mask that is True on the answer's tokens and its end: what the policy is to write.
    """
    if answer is None:
        asked, answered = tokenizer.encode(prompt), []
    else:
        asked, answered = tokenize_answer(tokenizer, prompt, answer)
        answered = [*answered, tokenizer.eos_id]
    start = 1 + len(asked)
    tokens = [tokenizer.bos_id, *asked, *answered]
    length = len(tokens)
    if length > max_length:
        raise UserError(
            f"text: {length} tokens are more than max_text_length {max_length}; raise it, or shorten {prompt!r}"
        )
    padded = np.full(max_length, tokenizer.pad_id, np.int32)
    padded[:length] = tokens
    place = np.arange(max_length)
    return Text(padded, place < length), (place >= start) & (place < length)
