"""The ray caster against MuJoCo: segmentation >= 99.9 %, depth p99 < 1 mm (2 minutes; --gl for OpenGL).

Run ``MUJOCO_GL=egl python -m benchmarks.raycast_parity --gl``.

Two oracles: ``mj_ray``, which intersects the same rays in double precision without OpenGL, and, with --gl, the
OpenGL renderer, which tessellates curved geoms and samples pixel centres. The ray caster's pixel (u, v) is the ray
through exactly (u, v), so against OpenGL its principal point is moved by half a pixel; then both sample the same rays.
Ids must agree on 99.9 % of the pixels, and there the 99th percentile of the depth error must be below 1 mm.
The exit code is 1 on a shortfall and 77 when no OpenGL context can be made.
"""
# pyright: reportAttributeAccessIssue=false

import argparse
import dataclasses
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from dsvla_jax.files import write_picture
from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.sim import raycast
from dsvla_jax.types import Camera

MIN_AGREEMENT = 0.999
MAX_DEPTH_ERROR = 1e-3
TIE = 1e-4  # metres
NO_OPENGL = 77


@dataclasses.dataclass(frozen=True)
class Parity:
    """agreement: fraction of pixels with equal ids; ties: fraction of pixels whose ids differ but whose depths do
    not, which betrays coincident surfaces. depth_p50, depth_p99: metres, over agreeing pixels.
    """

    agreement: float
    ties: float
    depth_p50: float
    depth_p99: float

    @property
    def passed(self) -> bool:
        return self.agreement >= MIN_AGREEMENT and self.depth_p99 < MAX_DEPTH_ERROR


def compare(segmentation, depth, expected_segmentation, expected_depth) -> Parity:
    """How far two pictures are apart; all arguments (H, W)."""
    same = segmentation == expected_segmentation
    hit = (segmentation >= 0) & (expected_segmentation >= 0)
    error = np.abs(depth - expected_depth)
    ties = ~same & hit & (error < TIE)
    p50, p99 = np.percentile(error[hit & same], [50, 99]) if (hit & same).any() else (np.nan, np.nan)
    return Parity(float(same.mean()), float(ties.mean()), float(p50), float(p99))


def primitive_scene(seed: int = 0) -> mujoco.MjModel:
    """Every drawable type at random poses on a table (a finite plane) over a floor (an infinite one).

    In front of them are spheres hidden by group and by alpha.
    """
    kinds = mujoco.mjtGeom
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    world = spec.worldbody
    world.add_geom(type=kinds.mjGEOM_PLANE, size=[0, 0, 1], rgba=[0.5, 0.5, 0.55, 1])
    world.add_geom(type=kinds.mjGEOM_PLANE, size=[0.5, 0.4, 1], pos=[0.1, 0, 0.752], rgba=[0.6, 0.5, 0.35, 1])
    curved = (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER)
    for kind in (*curved, kinds.mjGEOM_BOX):
        for _ in range(4):
            quat = rng.normal(size=4)
            world.add_geom(
                type=kind,
                size=rng.uniform(0.02, 0.08, 3),
                pos=rng.uniform([-0.2, -0.35, 0.78], [0.4, 0.35, 1.3]),
                quat=quat / np.linalg.norm(quat),
                rgba=[*rng.uniform(0.2, 0.9, 3), 1],
            )
    world.add_geom(type=kinds.mjGEOM_SPHERE, size=[0.1, 0, 0], pos=[0.6, 0, 1.2], group=3)
    world.add_geom(type=kinds.mjGEOM_SPHERE, size=[0.1, 0, 0], pos=[0.6, 0.1, 1.2], rgba=[1, 1, 1, 0])
    return spec.compile()


def raycast_view(model, data, camera: Camera, size: int, far: float = 1e6):
    """rgb, depth and segmentation of the ray caster as numpy arrays."""
    primitives = raycast.primitives_from_model(model)
    arrays = (jnp.asarray(a, jnp.float32) for a in (data.geom_xpos, data.geom_xmat, model.geom_rgba))
    return tuple(np.asarray(a) for a in raycast.render(primitives, *arrays, camera, size, size, far=far))


def mujoco_rays(model, data, camera: Camera, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Segmentation and planar depth (H, W) by mj_ray over the same rays; groups 0 to 2 only.

    mj_multiRay would be faster, but it culls bodies by the angles under which they appear and loses hits at the edges
    of some whose inertial frame is tilted.
    """
    directions = np.asarray(raycast.pixel_directions(camera, size, size), np.float64).reshape(-1, 3)
    # Unit directions, so that distances are metric: planar depth is the distance over the length of a Z = 1 ray.
    length = np.linalg.norm(directions, axis=1)
    eye = np.asarray(camera.world_from_camera, np.float64)[:3, 3].copy()
    groups, hit = np.array([1, 1, 1, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    ids, distance = np.zeros(len(directions), np.int32), np.zeros(len(directions))
    for i, direction in enumerate(directions / length[:, None]):
        distance[i] = mujoco.mj_ray(model, data, eye, direction, groups, True, -1, hit, None)
        ids[i] = hit[0]
    depth = np.where(ids >= 0, distance / length, 0.0)
    return ids.reshape(size, size), depth.reshape(size, size)


def half_pixel_shifted(camera: Camera) -> Camera:
    """The camera whose pixel (u, v) is the ray through (u + 0.5, v + 0.5) of ``camera``: OpenGL's pixel centre."""
    shift = jnp.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], jnp.float32)
    return dataclasses.replace(camera, intrinsics=camera.intrinsics - shift)


class OpenGLViews:
    """mujoco.Renderer looking through a ``Camera`` whose principal point is the middle of its square image."""

    def __init__(self, model: mujoco.MjModel, size: int, fine: bool = True):
        if fine:  # facets smaller than a pixel
            model.vis.quality.numslices = model.vis.quality.numstacks = 128
        self._renderer = mujoco.Renderer(model, size, size)
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._renderer.close()

    def view(self, data, camera: Camera):
        """rgb uint8 (H, W, 3), depth in metres, segmentation with -1 where no geom is."""
        renderer = self._renderer
        rgb = self._look(data, camera)
        renderer.enable_depth_rendering()
        depth = self._look(data, camera)
        renderer.disable_depth_rendering()
        renderer.enable_segmentation_rendering()
        identity, kind = np.moveaxis(self._look(data, camera), -1, 0)
        renderer.disable_segmentation_rendering()
        return rgb, depth, np.where(kind == int(mujoco.mjtObj.mjOBJ_GEOM), identity, -1)

    def _look(self, data, camera: Camera) -> np.ndarray:
        renderer = self._renderer
        renderer.update_scene(data, scene_option=self._option)
        pose = np.asarray(camera.world_from_camera, np.float64)
        for eye in renderer.scene.camera:
            eye.pos, eye.forward, eye.up = pose[:3, 3], pose[:3, 2], pose[:3, 1]
            eye.frustum_top = eye.frustum_near * 0.5 * renderer.height / -float(camera.intrinsics[0, 0])
            eye.frustum_bottom = -eye.frustum_top
            eye.frustum_center, eye.frustum_width = 0.0, 0.0  # 0: as the viewport's shape demands
        return renderer.render().copy()


def task_scenes(names: list[str]) -> Iterator[tuple[str, mujoco.MjModel, mujoco.MjData]]:
    """The scene of each task (all if ``names`` is empty) at a sampled start."""
    from dsvla_jax.sim.scene import build_scene
    from dsvla_jax.sim.tasks import TASKS, get_task

    for name in names or sorted(TASKS):
        scene = build_scene(get_task(name))
        model, state = scene.mj_model, scene.place(scene.task.sample(jax.random.key(0), jnp.int32(0)))
        data = mujoco.MjData(model)
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = state.qpos, state.mocap_pos, state.mocap_quat
        model.geom_rgba[:] = state.geom_rgba
        yield name, model, data


def timed(function, *args):
    """The result and the milliseconds of the fastest of three calls, after one that warms up."""
    result, elapsed = function(*args), []
    for _ in range(3):
        start = time.perf_counter()
        result = function(*args)
        elapsed.append((time.perf_counter() - start) * 1e3)
    return result, min(elapsed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", default="", help="comma-separated; default: all")
    parser.add_argument("--size", type=int, default=96, help="pixels a side")
    parser.add_argument("--primitives-only", action="store_true", help="only the scene of all primitives")
    parser.add_argument("--gl", action="store_true", help="compare with OpenGL too")
    parser.add_argument("--pictures", default="", help="folder for pictures: ray caster | OpenGL (with --gl)")
    args = parser.parse_args()

    def scenes():
        model = primitive_scene()
        yield "all primitives", model, mujoco.MjData(model)
        if not args.primitives_only:
            yield from task_scenes([name for name in args.tasks.split(",") if name])

    camera = front_camera(args.size)
    table = Table(
        "scene", "geoms", "oracle", "same %", "ties %", "depth p50 mm", "p99 mm", "ms", "oracle ms", "verdict"
    )
    failed = 0

    def add(name, model, oracle, parity, ours, theirs):
        nonlocal failed
        failed += not parity.passed
        agreement = (f"{parity.agreement * 100:.3f}", f"{parity.ties * 100:.3f}")
        verdict = "ok" if parity.passed else "[red]SHORT[/red]"
        errors = (f"{1e3 * parity.depth_p50:.4f}", f"{1e3 * parity.depth_p99:.4f}")
        table.add_row(name, str(model.ngeom), oracle, *agreement, *errors, f"{ours:.1f}", f"{theirs:.1f}", verdict)

    for name, model, data in scenes():
        mujoco.mj_forward(model, data)
        (rgb, depth, segmentation), ours = timed(raycast_view, model, data, camera, args.size)
        (ids, distance), theirs = timed(mujoco_rays, model, data, camera, args.size)
        add(name, model, "rays", compare(segmentation, depth, ids, distance), ours, theirs)
        pictures = [rgb]
        if args.gl:
            try:
                views = OpenGLViews(model, args.size)
            except Exception as error:  # a missing GL library surfaces as any of several types
                print(f"no OpenGL context (MUJOCO_GL={os.environ.get('MUJOCO_GL')}): {error}", file=sys.stderr)
                return NO_OPENGL
            with views:
                (gl_rgb, distance, ids), theirs = timed(views.view, data, camera)
            _, depth, segmentation = raycast_view(model, data, half_pixel_shifted(camera), args.size)
            add(name, model, "OpenGL", compare(segmentation, depth, ids, distance), ours, theirs)
            pictures.append(gl_rgb)
        if args.pictures:
            os.makedirs(args.pictures, exist_ok=True)
            write_picture(Path(args.pictures) / f"{name.replace(' ', '_')}.png", np.hstack(pictures))
    Console(width=max(120, Console().width)).print(table)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
