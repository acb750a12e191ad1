"""Keypoints from given masks lie within 1 cm of the objects' surface centres on every single-arm task (10 minutes).

Usage: python -m benchmarks.keypoint_geometry [--tasks single_arm] [--episodes 4] [--image-size 336] [--out FOLDER]

Masks and depth are the simulator's pictures. The surface centre is found without them: C MuJoCo casts nine rays a
pixel, and of the points where they meet the object, it is the one seen nearest to the centre of its silhouette. --out
draws every picture. The distance to the task's own keypoint, which need not be on that surface, is printed beside it.

An object that one can see through at its centre, as a rack of rails, has no surface centre: several of its parts are as
near. Its keypoint must lie on the object instead, within 1 cm of where the ray through it meets it.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import tyro

from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.files import write_picture
from dsvla_jax.perception.keypoints import Sighting, draw_sightings, locate
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.objects import object_geoms, object_masks
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import select_tasks
from dsvla_jax.sim.tasks.task import INVISIBLE_GROUP

LIMIT = 0.01
RAYS = 3  # along each side of a pixel


@dataclasses.dataclass(frozen=True)
class Options:
    """Which tasks, on how many episodes."""

    tasks: tuple[str, ...] = ("single_arm",)
    episodes: int = 4
    image_size: int = 336
    out: Path | None = None
    """Writes what was found into the pictures, as PNG files in this folder."""


def surface_error(environment: Environment, state: SimState, geoms: list[int], found: Sighting) -> tuple[float, bool]:
    """Metres from the keypoint of one example's object to its surface centre, and whether it has one; without, to where
    the ray through the keypoint's pixel meets the object. Only the place to look at is taken from the mask."""
    model = environment.scene.mj_model
    data = mujoco.MjData(model)
    data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = state.qpos, state.mocap_pos, state.mocap_quat
    mujoco.mj_forward(model, data)
    rows, columns = np.nonzero(found.mask)  # type: ignore[arg-type]
    v, u = (np.arange(at.min() - 2, at.max() + 3, 1 / RAYS) + (1 / RAYS - 1) / 2 for at in (rows, columns))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    pixels = np.concatenate([pixels, np.array([found.pixel])])
    k, pose = np.asarray(state.camera.intrinsics, float), np.asarray(state.camera.world_from_camera, float)
    rays = np.concatenate([(pixels - k[:2, 2]) / np.diag(k)[:2], np.ones((len(pixels), 1))], axis=1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    seen = np.ones(mujoco.mjNGROUP, np.uint8)
    seen[INVISIBLE_GROUP] = 0
    casts = [_cast(model, data, pose[:3, 3], ray, seen) for ray in rays]
    distance, hit = (np.array(column) for column in zip(*casts, strict=True))
    points, on = pose[:3, 3] + rays * distance[:, None], np.isin(hit, geoms) & (distance > 0)
    centre = pixels[:-1][on[:-1]].mean(axis=0)
    away = np.linalg.norm(pixels - centre, axis=1)
    away[~on] = np.inf
    nearest = int(away[:-1].argmin())
    solid = bool(away[nearest] <= 1)
    if not solid:
        nearest = len(pixels) - 1
        if not on[nearest]:
            return np.inf, solid
    return float(np.linalg.norm(found.point - points[nearest])), solid


def _cast(model: Any, data: Any, origin: np.ndarray, ray: np.ndarray, groups: np.ndarray) -> tuple[float, int]:
    geom = np.zeros(1, np.int32)
    return mujoco.mj_ray(model, data, origin, ray, groups, 1, -1, geom), int(geom[0])


def measure(name: str, options: Options) -> tuple[list[float], int, list[float]]:
    """Metres of every keypoint, how many have a surface centre, and metres of the first to the task's own first one."""
    environment = Environment(name, image_size=options.image_size)
    state = environment.reset(episode_keys(0, "validation", name, 0, options.episodes))
    seen = environment.render(state)
    masks = object_masks(environment, state, seen)
    own = np.asarray(environment.keypoints(state))
    errors, solids, to_own = [], 0, []
    for i in range(options.episodes):
        one: Any = jax.tree.map(lambda x, i=i: np.asarray(x)[i], state)
        task = environment.task
        phrases, depth = task.phrases(task.words(int(one.variation)))[0], np.asarray(seen.depth)[i]
        sightings = [
            locate(Sighting(phrase, mask), depth, one.camera) for phrase, mask in zip(phrases, masks[i], strict=True)
        ]
        for sighting, geoms in zip(sightings, object_geoms(environment, int(one.variation)), strict=True):
            if sighting.point is None:
                errors.append(np.inf)
                print(f"  {name} episode {i}, {sighting.phrase!r}: {sighting.problem}")
                continue
            error, solid = surface_error(environment, one, geoms, sighting)
            errors.append(error)
            solids += solid
        if sightings[0].point is not None:
            to_own.append(float(np.linalg.norm(sightings[0].point - own[i, 0, 0])))
        if options.out:
            options.out.mkdir(parents=True, exist_ok=True)
            picture = draw_sightings(np.asarray(seen.rgb)[i], sightings)
            write_picture(options.out / f"{name}-{i}.png", picture)
    return errors, solids, to_own


def main(options: Options) -> int:
    configure_jax()
    worst = 0.0
    for name in select_tasks(options.tasks):
        errors, solids, to_own = measure(name, options)
        worst = max(worst, *errors)
        print(
            f"{name:36} {len(errors)} keypoints, {solids} with a surface centre: median "
            f"{1000 * np.median(errors):.1f} mm, worst {1000 * max(errors):.1f} mm; "
            f"to the task's own {1000 * np.median(to_own):.0f} mm",
            flush=True,
        )
    print(f"worst of all: {1000 * worst:.1f} mm")
    return int(worst > LIMIT)


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
