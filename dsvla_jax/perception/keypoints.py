"""Masks of objects to keypoints in the world: the centre of each mask, moved onto the object, at the depth seen there.

3DS-VLA takes the centre of the object's mask (paper, section 3.3). A centre need not be on the object, and its edge has
the depth of what is behind it, so the centre is moved to the nearest pixel of the mask, off its edge, and the depth
is the median of the mask around it.
"""

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import jax
import numpy as np

from dsvla_jax.errors import UserError
from dsvla_jax.geometry.cameras import unproject_pixels
from dsvla_jax.types import Camera

# Pixels to each side of the keypoint over which the median depth is taken, and that it is kept from the mask's edge.
MARGIN = 1
ONE_END, OTHER_END = " (one end)", " (other end)"


@dataclasses.dataclass(frozen=True)
class Sighting:
    """What became of one phrase.

    mask: bool (H, W), None where the object was not found. score: of the detector, 0 to 1. box: x0, y0, x1, y1, pixels.
    problem: why there is no mask or no point; empty where there is one. point: float32 (3,), metres, world frame.
    pixel: (u, v) of the point.
    """

    phrase: str
    mask: np.ndarray | None = None
    score: float = 1.0
    box: tuple[float, float, float, float] | None = None
    problem: str = ""
    point: np.ndarray | None = None
    pixel: tuple[int, int] | None = None


_to_world = jax.jit(unproject_pixels)


class KeypointsNotFound(UserError):
    """Some object of the instruction was not found; the message names each and says why."""

    def __init__(self, sightings: Sequence[Sighting]) -> None:
        self.sightings = sightings
        problems = [f"{sighting.phrase!r}: {sighting.problem}" for sighting in sightings if sighting.point is None]
        super().__init__("keypoints not found: " + "; ".join(problems))


# rgb uint8 (H, W, 3) and phrases -> a sighting each, with a mask or a problem.
Segmenter = Callable[[np.ndarray, Sequence[str]], Sequence[Sighting]]


def locate(sighting: Sighting, depth: np.ndarray, camera: Camera) -> Sighting:
    """The sighting with its point in the world, or the problem of finding one; as it is if it has either.

    depth: float (H, W), planar, metres; 0 or non-finite where there is no reading. camera: of this depth map.
    """
    if sighting.mask is None or sighting.point is not None:
        return sighting
    if sighting.mask.shape != depth.shape:
        raise ValueError(f"mask: expected the shape of the depth map {depth.shape}, got {sighting.mask.shape}")
    pixel = keypoint_pixel(sighting.mask, np.isfinite(depth) & (depth > 0), end=_end(sighting.phrase))
    if pixel is None:
        what = "its mask is empty" if not sighting.mask.any() else "there is no depth reading on it"
        return dataclasses.replace(sighting, problem=what)
    u, v = pixel
    rows, columns = (slice(max(0, at - MARGIN), at + MARGIN + 1) for at in (v, u))
    around = depth[rows, columns][sighting.mask[rows, columns]]
    distance = np.median(around[np.isfinite(around) & (around > 0)])
    point = np.asarray(_to_world(np.float32(u), np.float32(v), np.float32(distance), camera))
    return dataclasses.replace(sighting, point=point, pixel=pixel)


def keypoint_pixel(mask: np.ndarray, readable: np.ndarray, end: str = "") -> tuple[int, int] | None:
    """(u, v): the pixel with a depth nearest to the mask's centre, moved off the mask's edge; None where none has.

    mask, readable: bool (H, W). end: `ONE_END` (the left one in the picture) or `OTHER_END` starts from an end of the
    mask along its longest direction instead of from the centre.
    """
    places = np.argwhere(mask)
    if not len(places):
        return None
    start = places.mean(axis=0)
    if end:
        directions = np.linalg.svd(places - start, full_matrices=False)[2]
        along = (places - start) @ (directions[0] if directions[0][1] > 0 else -directions[0])
        start = places[along.argmin() if end == ONE_END else along.argmax()].astype(float)
    on = np.argwhere(mask & readable)
    if not len(on):
        return None
    start = on[np.sum((on - start) ** 2, axis=1).argmin()]
    kernel = np.ones((2 * MARGIN + 1,) * 2, np.uint8)
    inside = cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    candidates = np.argwhere((inside > 0) & readable)
    # Of a lattice only joints may be left: another part of the object is no place to move to.
    candidates = candidates[np.max(np.abs(candidates - start), axis=1, initial=0) <= 2 * MARGIN]
    if len(candidates):
        start = candidates[np.sum((candidates - start) ** 2, axis=1).argmin()]
    v, u = start
    return int(u), int(v)


def find_keypoints(
    segment: Segmenter, rgb: np.ndarray, depth: np.ndarray, camera: Camera, arms: Sequence[Sequence[str]]
) -> tuple[np.ndarray, list[Sighting]]:
    """The keypoints float32 (A, K, 3) of phrases for each arm, and what was seen of each different phrase.

    rgb: uint8 (H, W, 3). Arms with fewer than K keypoints repeat their last.
    Raises KeypointsNotFound where any phrase has no point.
    """
    phrases = list(dict.fromkeys(phrase for arm in arms for phrase in arm))
    sightings = [locate(sighting, depth, camera) for sighting in segment(rgb, phrases)]
    points = {sighting.phrase: sighting.point for sighting in sightings}
    if any(point is None for point in points.values()):
        raise KeypointsNotFound(sightings)
    most = max(len(arm) for arm in arms)
    rows = [[points[arm[min(k, len(arm) - 1)]] for k in range(most)] for arm in arms]
    return np.array(rows, np.float32), sightings


class KeypointTracker:
    """The keypoints of one robot over an episode: the first frame's, as in the paper, or refreshed.

    refresh: looks again at every frame. An object that is out of sight, behind the arm most often, keeps the point
    where it was last seen; only in the first frame of an episode must all be found.
    """

    def __init__(self, segment: Segmenter, refresh: bool = False) -> None:
        self._segment, self._refresh = segment, refresh
        self._known: dict[str, Sighting] = {}

    def reset(self) -> None:
        """An episode begins."""
        self._known = {}

    def keypoints(
        self, rgb: np.ndarray, depth: np.ndarray, camera: Camera, arms: Sequence[Sequence[str]]
    ) -> np.ndarray:
        """float32 (A, K, 3), see `find_keypoints`."""

        def segment(rgb: np.ndarray, phrases: Sequence[str]) -> list[Sighting]:
            wanted = [phrase for phrase in phrases if self._refresh or phrase not in self._known]
            seen = {sighting.phrase: sighting for sighting in (self._segment(rgb, wanted) if wanted else ())}
            located = {phrase: locate(sighting, depth, camera) for phrase, sighting in seen.items()}
            self._known |= {phrase: sighting for phrase, sighting in located.items() if sighting.point is not None}
            return [self._known.get(phrase) or located[phrase] for phrase in phrases]

        return find_keypoints(segment, rgb, depth, camera, arms)[0]


def draw_sightings(rgb: np.ndarray, sightings: Sequence[Sighting]) -> np.ndarray:
    """A copy of the picture with masks tinted, boxes, keypoints, phrases and scores; what was not found is listed."""
    picture = np.ascontiguousarray(rgb).copy()
    scale = max(0.35, rgb.shape[0] / 900)
    for number, sighting in enumerate(sightings):
        hue = np.uint8([[[(37 * number) % 180, 220, 255]]])  # type: ignore[arg-type]
        colour = tuple(int(x) for x in cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0])  # type: ignore[arg-type]
        if sighting.mask is not None:
            picture[sighting.mask] = (0.6 * picture[sighting.mask] + 0.4 * np.array(colour)).astype(np.uint8)
        if sighting.box is not None:
            x0, y0, x1, y1 = (round(value) for value in sighting.box)
            cv2.rectangle(picture, (x0, y0), (x1, y1), colour, 1)
        if sighting.pixel is not None:
            cv2.circle(picture, sighting.pixel, max(3, rgb.shape[0] // 80), (0, 0, 0), 2, cv2.LINE_AA)
            cv2.circle(picture, sighting.pixel, max(3, rgb.shape[0] // 80), colour, -1, cv2.LINE_AA)
        text = f"{sighting.phrase} {sighting.score:.2f}" if not sighting.problem else f"{sighting.phrase}: not found"
        place = (4, round((number + 1) * 32 * scale))
        for shade, thickness in (((0, 0, 0), 3), (colour, 1)):
            cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, shade, thickness, cv2.LINE_AA)
    return picture


def _end(phrase: str) -> str:
    return next((end for end in (ONE_END, OTHER_END) if phrase.endswith(end)), "")
