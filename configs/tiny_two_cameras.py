"""`tiny` with the pictures of two cameras, front and wrist, on its tasks for one arm."""

from dataclasses import replace

from configs import tiny
from dsvla_jax.experiment import Experiment

CAMERAS = ("front", "wrist")


def config() -> Experiment:
    base = tiny.config()
    tasks = ("lamp_on", "put_rubbish_in_bin", "close_fridge")
    return replace(
        base,
        model=replace(base.model, cameras=len(CAMERAS)),
        data=replace(base.data, cameras=CAMERAS, tasks=tasks, folder="data/demos_two_cameras"),
    )
