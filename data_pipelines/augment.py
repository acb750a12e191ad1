"""Random variations of one recorded frame that keep it true: pure functions of (frame, generator) -> frame.

There is no flip: a mirrored picture is of a left-handed world, in which "left", a clock's hand and a screw mean
something else.

None of them changes its argument. Compose them in the ``to_sample`` that ``loader.make_loader`` takes.
"""

from dataclasses import replace

import cv2
import numpy as np

from data_pipelines.pictures import crop_intrinsics, crop_resize, random_box
from data_pipelines.records import Frame
from dsvla_jax.types import Picture, join_cameras, split_cameras


def random_offset(
    rng: np.random.Generator, max_offset: np.ndarray | tuple[float, ...] | float, step: float = 0.01
) -> np.ndarray:
    """float32 (3,), uniform over the whole multiples of `step` metres within ±max_offset ((3,) or one for all axes).

    Whole bins of the action text (1 cm) keep quantised text exactly consistent: every integer of an axis moves by the
    same amount.
    """
    limit = np.rint(np.broadcast_to(np.asarray(max_offset, np.float64), (3,)) / step).astype(int)
    return (rng.integers(-limit, limit + 1) * step).astype(np.float32)


def shift_world(frame: Frame, offset: np.ndarray) -> Frame:
    """Moves everything, the cameras too, by offset (3,) metres: pictures stay as they are, coordinates change.

    A point cloud made from the shifted cameras is shifted as well. A crop box in world coordinates is not, so prefer
    horizontal offsets where the cloud is cropped at the height of the table.
    """
    offset = np.asarray(offset, np.float32)
    if offset.shape != (3,):
        raise ValueError(f"offset: expected shape (3,), got {offset.shape}; give one number an axis")
    world_from_camera = frame.pictures.camera.world_from_camera.copy()
    world_from_camera[:, :3, 3] += offset
    camera = replace(frame.pictures.camera, world_from_camera=world_from_camera)
    return replace(
        frame,
        pictures=replace(frame.pictures, camera=camera),
        robot=replace(frame.robot, pose=_move(frame.robot.pose, offset)),
        target=replace(frame.target, pose=_move(frame.target.pose, offset)),
        past=frame.past
        and replace(frame.past, robot=replace(frame.past.robot, pose=_move(frame.past.robot.pose, offset))),
        later=frame.later and replace(frame.later, pose=_move(frame.later.pose, offset)),
        keypoint=frame.keypoint + offset,
    )


def jitter_state(frame: Frame, rng: np.random.Generator, max_offset: float, probability: float) -> Frame:
    """With `probability`, moves the end-effector positions that the policy is told by up to ±max_offset metres an axis.

    Target, keypoint and picture stay: the policy learns not to lean on the exact reading of its own state.
    """
    if rng.random() >= probability:
        return frame
    noise = rng.uniform(-max_offset, max_offset, (len(frame.robot.pose), 3)).astype(np.float32)
    return replace(frame, robot=replace(frame.robot, pose=_move(frame.robot.pose, noise)))


def perturb_keypoint(frame: Frame, rng: np.random.Generator, max_offset: float, probability: float) -> Frame:
    """With `probability`, moves the keypoints by uniform noise of up to ±max_offset metres an axis."""
    if rng.random() >= probability:
        return frame
    noise = rng.uniform(-max_offset, max_offset, frame.keypoint.shape).astype(np.float32)
    return replace(frame, keypoint=frame.keypoint + noise)


def crop(picture: Picture[np.ndarray], top: int, left: int, height: int, width: int) -> Picture[np.ndarray]:
    """One picture as seen through a window of it, at its own size again.

    Colour is interpolated, depth is the nearest pixel's, and the intrinsics move along, so that every reading stays at
    its place in the world to half a pixel of the picture; poses and keypoints are in the world and stay.
    """
    rows, columns = picture.depth.shape
    inside = top >= 0 and left >= 0 and top + height <= rows and left + width <= columns
    if not inside or min(height, width) < 2:
        raise ValueError(f"crop: expected a window within {rows} x {columns}, got {(top, left, height, width)}")
    box, size = (top, left, height, width), (rows, columns)
    return Picture(
        rgb=crop_resize(picture.rgb, box, size),
        depth=crop_resize(picture.depth, box, size, nearest=True),
        camera=replace(picture.camera, intrinsics=crop_intrinsics(picture.camera.intrinsics, box, size)),
    )


def random_crop(frame: Frame, rng: np.random.Generator, least: float) -> Frame:
    """A random window of each camera's picture, whose sides are a share between `least` and 1 of its; see `crop`."""
    rows, columns = frame.pictures.depth.shape[1:]
    cropped = [crop(one, *random_box(rng, rows, columns, least)) for one in split_cameras(frame.pictures)]
    return replace(frame, pictures=join_cameras(cropped))


def vary_colour(frame: Frame, rng: np.random.Generator, strength: float = 0.15) -> Frame:
    """Varies the colours of each camera's picture, see `_vary`. strength: relative."""
    rgb = np.stack([_vary(one, rng, strength) for one in frame.pictures.rgb])
    return replace(frame, pictures=replace(frame.pictures, rgb=rgb))


def _vary(rgb: np.ndarray, rng: np.random.Generator, strength: float) -> np.ndarray:
    """Random brightness, contrast and saturation of up to ±strength, and a hue turn of up to strength * 20 degrees.

    The hue turn stays small because instructions name colours. rgb: uint8 (H, W, 3).
    """
    brightness, contrast, saturation = 1 + rng.uniform(-strength, strength, 3)
    hue = rng.uniform(-strength, strength) * 20
    hsv = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2HSV)
    hsv[..., 0] = (hsv[..., 0] + hue) % 360
    hsv[..., 1] = np.clip(hsv[..., 1] * saturation, 0, 1)
    varied = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB) * brightness
    varied = (varied - varied.mean()) * contrast + varied.mean()
    return np.rint(np.clip(varied, 0, 1) * 255).astype(np.uint8)


def _move(poses: np.ndarray, offset: np.ndarray) -> np.ndarray:
    moved = poses.copy()
    moved[..., :3] += offset
    return moved
