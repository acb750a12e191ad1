"""What every observation must satisfy, whoever brings it: recordings, importers and the server refuse the same things.

Each check (but `has_words`) raises DataError, which names what was wrong, what was expected and the fix.
"""

import jax.numpy as jnp
import numpy as np

from dsvla_jax.errors import DataError
from dsvla_jax.geometry.cameras import project
from dsvla_jax.types import Camera

# How far a rotation matrix may be from orthonormal and a quaternion from unit length.
ROTATION_TOLERANCE = 1e-3
QUATERNION_TOLERANCE = 1e-2
# Metres: no arm or camera of a table-top scene is farther from the origin, so larger numbers are other units.
MAX_COORDINATE = 20.0
# Metres: how far from everything seen in their directions all keypoints of objects may be.
SURFACE_TOLERANCE = 0.1
# Metres: a depth map whose middle value is above this is in other units.
MAX_MIDDLE_DEPTH = 20.0
# Of all readings, the least share that must lie in the workspace: fewer, and the camera, the units or the workspace are
# those of another set-up. Measured: in any of 560 samples of the 26 simulated tasks 8.6 % or more do, in imported ones
# of a box on RLBench's table 6.2 %; with a camera in millimetres or turned about x, or a table at z = 0, none do.
MIN_WORKSPACE_SHARE = 0.02
# Metres: the largest reading that 16 bits of 0.1 mm hold, as depth is stored.
MAX_DEPTH = 6.5535
KEYPOINT_FIX = "give metres in the world frame, and world_from_camera, not its inverse"


def has_words(instruction: str) -> bool:
    """Whether an instruction says anything: not where it is empty, blank, or the "nan" of a table's empty cell."""
    return instruction.strip().lower() not in ("", "nan")


def check_poses(pose: np.ndarray, where: object) -> None:
    """Raises DataError unless every pose (T, A, 7) is finite, in metres, and has a unit quaternion."""
    finite = np.isfinite(pose).all(axis=(1, 2))
    if not finite.all():
        place = f"{where}, observation {int(np.argmin(finite))}"
        fix = "leave out observations without a pose, or the whole recording"
        raise DataError(place, "pose", "finite numbers", f"{pose[np.argmin(finite)].tolist()}", fix)
    far = np.abs(pose[..., :3]).max(axis=(1, 2))
    if far.max() > MAX_COORDINATE:
        place = f"{where}, observation {int(np.argmax(far))}"
        raise DataError(
            place, "pose", "metres from the world's origin", f"{far.max():.4g}", "divide millimetres by 1000"
        )
    length = np.linalg.norm(pose[..., 3:], axis=-1)
    error = np.abs(length - 1).max(axis=1)
    if error.max() > QUATERNION_TOLERANCE:
        worst = int(np.argmax(error))
        fix = "give qx qy qz qw, not Euler angles or an axis times an angle"
        raise DataError(
            f"{where}, observation {worst}", "pose", "a unit quaternion", f"length {length[worst].tolist()}", fix
        )


def check_pictures(rgb: np.ndarray, depth: np.ndarray, where: object) -> None:
    """Raises DataError unless one observation's picture and depth map are what they have to be."""
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[-1] != 3:
        fix = "give whole numbers from 0 to 255 and three channels" + (
            "; multiply numbers from 0 to 1 by 255 first" if rgb.dtype.kind == "f" else ""
        )
        raise DataError(where, "rgb", "uint8 (H, W, 3)", f"{rgb.dtype} {rgb.shape}", fix)
    if depth.shape != rgb.shape[:2]:
        fix = "register depth to the colour camera: both must be seen by one camera at one size"
        raise DataError(where, "depth", f"{rgb.shape[:2]} as of rgb", str(depth.shape), fix)
    if depth.dtype.kind != "f":
        fix = "divide by 1000 if these are millimetres, and give floating point"
        raise DataError(where, "depth", "metres as floating point", f"{depth.dtype} up to {depth.max()}", fix)
    check_depth(depth, where)
    if depth.min() < 0 or depth.max() > MAX_DEPTH:
        span = f"{depth.min():.4g} to {depth.max():.4g}"
        raise DataError(where, "depth", f"0 to {MAX_DEPTH:g} m", span, "write 0 for what is out of the camera's range")


def check_depth(depth: np.ndarray, where: object) -> None:
    """Raises DataError unless a depth map (H, W) of floats is finite, has readings, and can be metres."""
    if count := int(np.sum(~np.isfinite(depth))):
        raise DataError(where, "depth", "finite values", f"{count} non-finite pixels", "write 0 for a missing reading")
    readings = depth[depth != 0]
    if not len(readings):
        raise DataError(where, "depth", "some readings", "0 everywhere", "check that the depth stream was on")
    # The largest first: a median takes as long as decoding a picture does.
    if readings.max() > MAX_MIDDLE_DEPTH and np.median(readings) > MAX_MIDDLE_DEPTH:
        fix = "divide by 1000 if these are millimetres"
        raise DataError(where, "depth", "metres", f"a median of {np.median(readings):.4g}", fix)


def check_camera(intrinsics: np.ndarray, world_from_camera: np.ndarray, size: tuple[int, ...], where: object) -> None:
    """Raises DataError unless (3, 3) and (4, 4) calibrate pictures of size (height, width)."""
    if not (np.isfinite(intrinsics).all() and np.isfinite(world_from_camera).all()):
        raise DataError(where, "camera", "finite numbers", "non-finite ones", "calibrate the camera")
    height, width = size
    row = intrinsics[2].tolist()
    if row != [0, 0, 1] or intrinsics[0, 0] == 0 or intrinsics[1, 1] == 0 or intrinsics[1, 0] != 0:
        fix = "give [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels"
        raise DataError(where, "intrinsics", "a pinhole camera's matrix", str(intrinsics.tolist()), fix)
    u, v = intrinsics[0, 2], intrinsics[1, 2]
    # A whole sensor's optical axis is near the middle of its picture; that of a crop need not be.
    if not (0 <= u < width and 0 <= v < height):
        fix = "scale the intrinsics with the picture: they are of another size"
        raise DataError(where, "intrinsics", f"a centre in {width} x {height} pixels", f"({u:.1f}, {v:.1f})", fix)
    rotation = world_from_camera[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > ROTATION_TOLERANCE:
        fix = "columns must be of unit length and at right angles"
        raise DataError(where, "world_from_camera", "a rotation", f"one off by {error:.2g}", fix)
    if np.linalg.det(rotation) < 0:
        fix = "one axis has the wrong sign, or x and y are exchanged"
        raise DataError(where, "world_from_camera", "a rotation", "a mirror image", fix)
    if world_from_camera[3].tolist() != [0, 0, 0, 1]:
        fix = "give [[R, t], [0, 0, 0, 1]]; a transposed matrix has t in its last row"
        raise DataError(where, "world_from_camera", "a last row 0 0 0 1", str(world_from_camera[3].tolist()), fix)
    if np.abs(world_from_camera[:3, 3]).max() > MAX_COORDINATE:
        got = f"{world_from_camera[:3, 3].tolist()}"
        raise DataError(where, "world_from_camera", "a place in metres", got, "divide millimetres by 1000")


def check_in_view(
    points: np.ndarray, intrinsics: np.ndarray, world_from_camera: np.ndarray, size: tuple[int, ...], where: object
) -> None:
    """Raises DataError unless the camera of one step sees one of that step's points, such as the hands, at least.

    points (T, A, 3), intrinsics (T, 3, 3), world_from_camera (T, 4, 4), size (height, width).
    """
    pose = np.asarray(world_from_camera, np.float64)
    seen = np.einsum("tji,taj->tai", pose[:, :3, :3], points - pose[:, None, :3, 3])
    pixels = np.einsum("tij,taj->tai", np.asarray(intrinsics, np.float64), seen)
    before = seen[..., 2] > 0
    pixels = pixels[..., :2] / np.where(before, seen[..., 2], 1.0)[..., None]
    if not np.any(before & np.all((pixels >= 0) & (pixels < [size[1], size[0]]), axis=-1)):
        got = f"none: at step 0 it is {seen[0, 0, 2]:.2f} m along the viewing direction"
        fix = "check the extrinsic matrix (or is it the inverse?), the intrinsics, and the frame of the poses"
        raise DataError(where, "camera", f"the hand in one {size[1]} x {size[0]} picture at least", got, fix)


def check_keypoints(
    keypoints: np.ndarray,
    intrinsics: np.ndarray,
    world_from_camera: np.ndarray,
    size: tuple[int, ...],
    where: object,
    fix: str = KEYPOINT_FIX,
) -> None:
    """Raises DataError where keypoints (A, K, 3) are not finite, one is behind the camera, or all are out of view.

    intrinsics (3, 3), world_from_camera (4, 4), size (height, width): of the first picture. fix: said to people.
    """
    if not np.isfinite(keypoints).all():
        raise DataError(where, "keypoints", "finite numbers", "non-finite ones", "or None where not known")
    if not keypoints.size:
        return
    camera = Camera(jnp.asarray(intrinsics, jnp.float32), jnp.asarray(world_from_camera, jnp.float32))
    pixels, depth = map(np.asarray, project(np.asarray(keypoints, np.float32), camera))
    if depth.min() <= 0:
        arm, place = np.unravel_index(int(np.argmin(depth)), depth.shape)
        got = f"{keypoints[arm, place].tolist()}, {float(depth[arm, place]):.3f} m along the viewing direction"
        raise DataError(where, f"keypoints[{arm}, {place}]", "a point before the camera", got, fix)
    if not np.any(np.all((pixels >= 0) & (pixels < [size[1], size[0]]), axis=-1)):
        got = f"pixels {np.rint(pixels).astype(int).tolist()}"
        raise DataError(where, "keypoints", f"one in the first {size[1]} x {size[0]} picture", got, fix)


def check_surface(
    depth: np.ndarray, intrinsics: np.ndarray, world_from_camera: np.ndarray, keypoints: np.ndarray, where: object
) -> None:
    """Raises DataError unless a keypoint (A, K, 3) of objects is near what the camera sees where it projects to.

    Catches a calibration, a unit or a frame that is wrong though each number looks right. Passes where no keypoint
    before the camera is on a pixel with a reading, and where any is within `SURFACE_TOLERANCE`: others may be hidden or
    in the air.
    """
    camera = Camera(jnp.asarray(intrinsics), jnp.asarray(world_from_camera))
    pixels, distance = map(np.asarray, project(np.asarray(keypoints, np.float32).reshape(-1, 3), camera))
    errors = []
    for (u, v), expected in zip(np.rint(pixels).astype(int), distance, strict=True):
        # A keypoint is a little inside its object, and seen edges are ragged: the nearest reading around it counts.
        window = depth[max(v - 2, 0) : max(v + 3, 0), max(u - 2, 0) : max(u + 3, 0)]
        if expected > 0 and (window > 0).any():
            errors.append(np.abs(window[window > 0] - expected).min())
    if errors and min(errors) > SURFACE_TOLERANCE:
        got = f"{min(errors):.2f} m between the nearest of them and what is seen in its direction"
        fix = "check world_from_camera (or is it the inverse?), intrinsics, and the frame of the keypoints"
        raise DataError(where, "keypoints", "points on things that the camera sees", got, fix)


def points_in_workspace(
    depth: np.ndarray,
    intrinsics: np.ndarray,
    world_from_camera: np.ndarray,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
) -> tuple[int, int]:
    """How many points of a depth map (H, W) lie in the box from ``low`` to ``high``, and how many readings it has.

    low, high: metres, world frame. A pixel has a reading where its depth is finite and positive.
    """
    depth = np.asarray(depth, np.float64)
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    rays = pixels @ np.linalg.inv(np.asarray(intrinsics, np.float64)).T
    pose = np.asarray(world_from_camera, np.float64)
    points = rays * depth[rows, columns][:, None] @ pose[:3, :3].T + pose[:3, 3]
    return int(np.all((points >= low) & (points <= high), axis=-1).sum()), len(rows)


def check_workspace(
    inside: int, readings: int, low: tuple[float, float, float], high: tuple[float, float, float], where: object
) -> None:
    """Raises DataError unless at least `MIN_WORKSPACE_SHARE` of the readings lie in the workspace.

    inside, readings: as `points_in_workspace` counts them, of one picture or summed over several.
    """
    if inside < max(MIN_WORKSPACE_SHARE * readings, 1):
        fix = "check world_from_camera, intrinsics and the unit of depth, or set the workspace to the data's"
        got = f"{inside} of {readings} readings"
        expected = f"at least {MIN_WORKSPACE_SHARE:.0%} of the readings in the workspace from {low} to {high}"
        raise DataError(where, "depth", expected, got, fix)
