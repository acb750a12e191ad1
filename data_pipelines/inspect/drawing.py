"""Pictures of one recorded frame: marks on the image, and its cloud seen from above and from the side."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from data_pipelines.records import Frame
from dsvla_jax.evaluation.pictures import mark_targets
from dsvla_jax.geometry.cameras import project, unproject
from dsvla_jax.types import Picture, split_cameras

CLOUD_SIZE = 320
_KEYPOINT = (255, 220, 0)
_POSE = (255, 255, 255)
_TARGET = (255, 0, 200)
# Metres around all marks that are drawn of the cloud: with the far floor, all else would be tiny.
_MARGIN = 0.4


def draw_frame(frame: Frame) -> np.ndarray:
    """The pictures of C cameras one below the other, uint8 (C H, W, 3), see `_draw_picture`."""
    return np.concatenate([_draw_picture(picture, frame) for picture in split_cameras(frame.pictures)])


def _draw_picture(picture: Picture[np.ndarray], frame: Frame) -> np.ndarray:
    """uint8 (H, W, 3): one picture with a ring at each arm's target and a yellow cross at each active keypoint."""
    camera = jax.tree.map(jnp.asarray, picture.camera)
    drawn = mark_targets(picture.rgb, frame.target.pose[:, :3], camera)
    height, width = drawn.shape[:2]
    if not len(frame.keypoint):
        return drawn
    pixels, depth = map(np.asarray, project(frame.keypoint, camera))
    for (u, v), z in zip(pixels, depth, strict=True):
        if z > 0 and 0 <= u < width and 0 <= v < height:
            place = (round(float(u)), round(float(v)))
            for colour, thickness in (((0, 0, 0), 3), (_KEYPOINT, 1)):
                cv2.drawMarker(drawn, place, colour, cv2.MARKER_CROSS, max(6, height // 12), thickness)
    return drawn


def frame_cloud(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Every reading of all cameras as a world point float32 (P, 3), and its colour uint8 (P, 3)."""
    points, colours = [], []
    for picture in split_cameras(frame.pictures):
        measured = picture.depth > 0
        places = np.asarray(unproject(picture.depth, jax.tree.map(jnp.asarray, picture.camera)))
        points.append(places[measured])
        colours.append(picture.rgb[measured])
    return np.concatenate(points), np.concatenate(colours)


def draw_clouds(frame: Frame) -> list[tuple[str, np.ndarray]]:
    """(caption, picture) of the cloud from above and from the side, with pose, target and keypoint."""
    points, colours = frame_cloud(frame)
    marks = [(frame.robot.pose[:, :3], _POSE), (frame.target.pose[:, :3], _TARGET), (frame.keypoint, _KEYPOINT)]
    views = {
        "cloud from above: y to the right, x down": (1, 0, 2, (1, 1)),
        "cloud from the side: x to the right, z up": (0, 2, 1, (1, -1)),
    }
    return [(caption, _draw_view(points, colours, marks, *view)) for caption, view in views.items()]


def _draw_view(
    points: np.ndarray,
    colours: np.ndarray,
    marks: list[tuple[np.ndarray, tuple[int, int, int]]],
    across: int,
    down: int,
    away: int,
    signs: tuple[int, int],
) -> np.ndarray:
    """An orthographic picture; `away`: the axis along which later points hide earlier ones."""
    picture = np.full((CLOUD_SIZE, CLOUD_SIZE, 3), 32, np.uint8)
    if not len(points):
        return picture

    def flat(places: np.ndarray) -> np.ndarray:
        return places[:, [across, down]] * signs

    marked = flat(np.concatenate([places for places, _ in marks]))
    low, high = marked.min(axis=0) - _MARGIN, marked.max(axis=0) + _MARGIN
    scale = CLOUD_SIZE / float((high - low).max())
    middle = (low + high) / 2

    def pixels(places: np.ndarray) -> np.ndarray:
        return np.rint((flat(places) - middle) * scale + CLOUD_SIZE / 2).astype(int)

    order = np.argsort(points[:, away])
    drawn, shades = pixels(points[order]), colours[order]
    inside = ((drawn >= 0) & (drawn < CLOUD_SIZE)).all(axis=1)
    # Circles hide gaps between pixels; later ones cover earlier ones, so that the nearest point is seen.
    for place, shade in zip(drawn[inside].tolist(), shades[inside].tolist(), strict=True):
        cv2.circle(picture, place, 2, shade, -1)
    for places, colour in marks:
        for place in pixels(places).tolist():
            cv2.circle(picture, tuple(place), 6, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.circle(picture, tuple(place), 6, colour, 2, cv2.LINE_AA)
    return picture
