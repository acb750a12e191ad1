"""The simulator's own segmentation as masks of the objects that tasks name: what a perfect detector would find."""

import re

import numpy as np

from dsvla_jax.errors import UserError
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.rendering import Rendering
from dsvla_jax.sim.tasks.task import fill


def object_geoms(environment: Environment, variation: int) -> list[list[int]]:
    """The geom ids of each of the task's objects, in the order of `Task.objects`.

    Raises UserError if the task names no objects, or a geoms expression matches no geom of the scene.
    """
    model, task = environment.scene.mj_model, environment.task
    if not task.objects:
        raise UserError(
            f"task {task.name}: objects: expected a TaskObject for each thing that the instruction names, got none; add"
            " them to the task, or use its own keypoints (--data.keypoints oracle)"
        )
    names, words = [model.geom(i).name for i in range(model.ngeom)], task.words(variation)
    found = []
    for each in task.objects:
        pattern = fill(each.geoms, words)
        found.append([i for i, name in enumerate(names) if re.fullmatch(pattern, name)])
        if not found[-1]:
            raise UserError(
                f"task {task.name}: objects: expected a geom whose whole name matches {pattern!r}, got "
                f"{', '.join(filter(None, names))}; correct `geoms` of {each.phrase!r}"
            )
    return found


def object_masks(environment: Environment, state: SimState, seen: Rendering) -> np.ndarray:
    """bool (B, K, H, W): the visible pixels of the K objects of the environment's task, in the order of `objects`.

    seen: what `Environment.render` drew of the state.
    """
    segmentation = np.asarray(seen.segmentation)
    return np.array(
        [
            [np.isin(shown, geoms) for geoms in object_geoms(environment, variation)]
            for shown, variation in zip(segmentation, np.asarray(state.variation).tolist(), strict=True)
        ]
    )
