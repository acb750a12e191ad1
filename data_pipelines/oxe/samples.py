"""From encoded frames to a batch of examples.

The prompt is the one of simulated demonstrations without the keypoint sentence. Where there is no calibrated depth,
`depth` is one missing pixel and the camera zeros: a policy without 3D tokens reads neither. Examples have one camera.
"""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Float

from data_pipelines.oxe.mixture import EncodedSample
from data_pipelines.oxe.scale import MixtureScale
from data_pipelines.pictures import crop_intrinsics, crop_resize, random_box, vary_light
from data_pipelines.rlds.features import decode_image
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.encode import encode_text
from dsvla_jax.encoding.number_targets import number_rows
from dsvla_jax.encoding.prompts import format_answer, format_prompt
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import DataError
from dsvla_jax.observation_checks import check_depth
from dsvla_jax.types import Camera, Example, Picture, Text


def make_batcher(
    config: OxeConfig,
    encoding: EncodingConfig,
    tokenizer: Tokenizer,
    scale: MixtureScale | None,
    seed: int,
    leave_out: Callable[[tuple[str, str]], None],
) -> Callable[[Sequence[tuple[int, EncodedSample]]], Example[np.ndarray] | None]:
    """``batch(numbered frames)``. scale: for relative targets. A frame's variation depends on `seed` and its number.

    leave_out: is told of frames whose picture cannot be decoded where `config.skip_bad`. Such a frame gives its place
    to its neighbour in the batch; a batch without any other gives None.
    """
    numbers = number_rows(tokenizer, encoding.style)

    def words(prompt: str, answer: str, bins: np.ndarray) -> tuple[Text[np.ndarray], np.ndarray, np.ndarray]:
        text, answer_mask = encode_text(tokenizer, prompt, answer, encoding.max_text_length)
        rows = np.zeros(len(text.tokens), np.int32)
        rows[answer_mask] = numbers.rows(bins)
        return text, answer_mask, rows

    def batch(frames: Sequence[tuple[int, EncodedSample]]) -> Example[np.ndarray] | None:
        # All texts and then all pictures: by turns, each would push the other out of the processor's caches.
        texts = [words(*one) for one in prompts_and_answers([frame for _, frame in frames], encoding, scale)]
        rgb = np.empty((len(frames), config.image_size, config.image_size, 3), np.uint8)
        views: dict[int, tuple[np.ndarray, Camera[np.ndarray]]] = {}
        for row, (number, frame) in enumerate(frames):
            try:
                rng = np.random.default_rng([seed, number])
                views[row] = write_picture(frame, rng, config, encoding.use_points, rgb[row])
            except DataError as error:
                if not config.skip_bad:
                    raise
                leave_out((frame.where, str(error).removeprefix(f"{frame.where}: ")))
        if not views:
            return None
        chosen = list(range(len(frames)))
        if len(views) < len(frames):
            chosen = [min(views, key=lambda other: abs(other - row)) for row in chosen]
            rgb = rgb[chosen]
        rows = [(views[row], texts[row]) for row in chosen]
        (depth, camera), (text, answer_mask, number_rows) = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
        pictures = jax.tree.map(lambda x: x[:, None], Picture(rgb, depth, camera))
        return Example(pictures, text, answer_mask, number_rows)

    return batch


def prompts_and_answers(
    frames: Sequence[EncodedSample], encoding: EncodingConfig, scale: MixtureScale | None
) -> list[tuple[str, str, np.ndarray]]:
    """The texts of each sample, and its answer's bins, integers (A, 8). scale: for relative targets."""
    texts: dict[int, tuple[str, str, np.ndarray]] = {}
    # All frames of as many arms at once: of one, NumPy's calls would take as long as a fifth of decoding its picture.
    for arms in {len(frame.pose) for frame in frames}:
        places = [place for place, frame in enumerate(frames) if len(frame.pose) == arms]
        group = [frames[place] for place in places]
        poses = np.stack([[frame.pose for frame in group], targets_of(group, encoding, scale)])
        grippers = np.stack([[frame.gripper_open for frame in group], [frame.target_gripper for frame in group]])
        states, bins = np.asarray(encoding.codec.encode(poses, grippers))
        for place, frame, state, target in zip(places, group, states, bins, strict=True):
            prompt = format_prompt(frame.instruction, state, None, encoding.style)
            texts[place] = prompt, format_answer(target, encoding.style), target
    return [texts[place] for place in range(len(frames))]


def targets_of(frames: Sequence[EncodedSample], encoding: EncodingConfig, scale: MixtureScale | None) -> np.ndarray:
    """(N, A, 7) of frames of as many arms: the target poses, or the displacements as poses inside the codec's box."""
    if scale is None:
        return np.array([frame.target_pose for frame in frames])
    displacements = [
        scale.to_mixture(frame.dataset, frame.displacement) for frame in frames if frame.displacement is not None
    ]
    return scale.scale.to_pose(np.stack(displacements), encoding.codec)


def write_picture(
    frame: EncodedSample, rng: np.random.Generator, config: OxeConfig, use_points: bool, rgb: np.ndarray
) -> tuple[Float[np.ndarray, "h w"], Camera[np.ndarray]]:
    """Writes `rgb` (S, S, 3); returns depth and camera, which a crop moves along."""
    picture = decode_image(frame.picture, frame.format, frame.where)
    height, width = picture.shape[:2]
    box = random_box(rng, height, width, config.crop) if config.crop < 1 else (0, 0, height, width)
    size = config.image_size, config.image_size
    picture = crop_resize(picture, box, size)
    if config.colour_variation > 0:
        vary_light(picture, rng, config.colour_variation, rgb)
    else:
        rgb[:] = picture
    depth, intrinsics, pose = np.zeros((1, 1), np.float32), np.zeros((3, 3), np.float32), np.zeros((4, 4), np.float32)
    if use_points and (camera := frame.camera) is not None:
        counts = decode_image(camera.depth, camera.depth_format, f"{frame.where}: depth")[..., 0]
        if counts.shape != (height, width):
            fix = "only depth of the picture's own size can be used"
            raise DataError(frame.where, "depth", f"{height} x {width}", f"{counts.shape[0]} x {counts.shape[1]}", fix)
        check_depth(counts * np.float32(camera.depth_unit), frame.where)
        depth = crop_resize(counts, box, size, nearest=True) * np.float32(camera.depth_unit)
        intrinsics, pose = crop_intrinsics(camera.intrinsics, box, size), camera.world_from_camera
    return depth, Camera(intrinsics, pose)
