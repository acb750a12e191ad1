"""Whether what the cameras of a source see lies in the workspace, and the box that would hold it."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.observation_checks import MIN_WORKSPACE_SHARE, check_workspace, points_in_workspace

Corner = tuple[float, float, float]

MARGIN = 0.4
"""Metres around all places of the hands that a fitted box holds: the objects, and the arms above them."""
LAYER = 0.01
"""Metres: the thickness in which a table's readings lie."""
TABLE_SHARE = 0.25
"""Of the readings around the hands: a layer with more of them is a table. It would take most points of every cloud."""
CLEARANCE = 0.008
"""Metres above a table at which a fitted box begins, as the default workspace does above RLBench's."""
SIDE = 64
"""Readings along a side of a picture that a box is fitted to, at most about twice as many."""


@dataclasses.dataclass(frozen=True)
class View:
    """One look of a camera. World frame, metres.

    depth: (H, W). intrinsics: (3, 3). world_from_camera: (4, 4). hands: (N, 3), where the hands are and are to go.
    """

    depth: np.ndarray
    intrinsics: np.ndarray
    world_from_camera: np.ndarray
    hands: np.ndarray


@dataclasses.dataclass(frozen=True)
class PointCount:
    """Over some views: points in the workspace, pixels that could give one, and readings among them."""

    inside: int
    pixels: int
    readings: int
    views: int


def count_points(views: Sequence[View], encoding: EncodingConfig) -> PointCount:
    """Counts what the policy would get, at the stride of the encoding."""
    inside = pixels = readings = 0
    for view in views:
        depth, intrinsics = _strided(view, encoding.stride)
        box = encoding.workspace_low, encoding.workspace_high
        here, measured = points_in_workspace(depth, intrinsics, view.world_from_camera, *box)
        inside, pixels, readings = inside + here, pixels + depth.size, readings + measured
    return PointCount(inside, pixels, readings, len(views))


def require_points(where: object, views: Sequence[View], encoding: EncodingConfig) -> PointCount:
    """Counts the points. Raises UserError where too few lie in the workspace, with the box that would hold them."""
    count = count_points(views, encoding)
    try:
        box = encoding.workspace_low, encoding.workspace_high
        check_workspace(count.inside, count.readings, *box, where)
    except DataError as error:
        raise UserError(f"{error}. {_advice(views)}") from error
    return count


def fit_box(views: Sequence[View]) -> tuple[Corner, Corner] | None:
    """The corners of a box around the hands that holds at least `MIN_WORKSPACE_SHARE` of the readings, or None.

    It reaches `MARGIN` beyond all hands; below them it ends just above the table, where there is one.
    """
    points, hands = _points(views), np.concatenate([view.hands for view in views])
    if not len(hands) or not len(points):
        return None
    low, high = hands.min(axis=0) - MARGIN, hands.max(axis=0) + MARGIN
    inside = points[np.all((points >= low) & (points <= high), axis=1)]
    if len(inside) < MIN_WORKSPACE_SHARE * len(points):
        return None
    table = _table(inside[inside[:, 2] < hands[:, 2].min() + LAYER, 2], len(inside))
    if table is not None:
        above = inside[:, 2] >= table + CLEARANCE
        # A bare table is all that there is to see: then it is kept.
        low[2] = table + CLEARANCE if above.sum() >= MIN_WORKSPACE_SHARE * len(points) else low[2]
    return _corner(np.floor(low * 1000) / 1000), _corner(np.ceil(high * 1000) / 1000)


def as_options(box: tuple[Corner, Corner]) -> str:
    """The box as options of train.py."""
    low, high = (" ".join(f"{value:g}" for value in corner) for corner in box)
    return f"--encoding.workspace-low {low} --encoding.workspace-high {high}"


def _table(heights: np.ndarray, total: int) -> float | None:
    """The height of the fullest layer, where that has `TABLE_SHARE` of all readings."""
    if not len(heights):
        return None
    layers, counts = np.unique(np.round(heights / LAYER), return_counts=True)
    fullest = layers[int(np.argmax(counts))] * LAYER
    near = heights[np.abs(heights - fullest) <= LAYER]
    return float(np.median(near)) if len(near) >= TABLE_SHARE * total else None


def _advice(views: Sequence[View]) -> str:
    if box := fit_box(views):
        return f"The box around the hands is {as_options(box)}, which --fit-workspace finds by itself"
    points, hands = _points(views), np.concatenate([view.hands for view in views])
    told = [
        f"{name} are between {np.round(places.min(axis=0), 2).tolist()} and {np.round(places.max(axis=0), 2).tolist()}"
        for name, places in (("hands", hands), ("readings", points))
        if len(places)
    ]
    return f"No box around the hands holds as many: {', '.join(told)}"


def _points(views: Sequence[View]) -> np.ndarray:
    """(P, 3): some readings of all views."""
    clouds = [np.zeros((0, 3))]
    for view in views:
        depth, intrinsics = _strided(view, max(1, max(view.depth.shape) // SIDE))
        rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(intrinsics).T
        pose = np.asarray(view.world_from_camera, np.float64)
        clouds.append(rays * depth[rows, columns][:, None] @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(clouds)


def _strided(view: View, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Every `stride`-th pixel of every such row, and the intrinsics of that picture, float64."""
    shrink = np.diag([1 / stride, 1 / stride, 1.0])
    return view.depth[::stride, ::stride], shrink @ np.asarray(view.intrinsics, np.float64)


def _corner(values: np.ndarray) -> Corner:
    x, y, z = (round(float(value), 3) for value in values)
    return x, y, z
