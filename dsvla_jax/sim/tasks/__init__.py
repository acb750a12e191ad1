"""The manipulation tasks, by their RLBench names."""

import difflib

from dsvla_jax.errors import UserError
from dsvla_jax.sim.tasks import bimanual_lift_ball, close_fridge, lamp_on, put_rubbish_in_bin
from dsvla_jax.sim.tasks.task import Graspable, Placement, StateLayout, StateView, Task

__all__ = ["TASKS", "Graspable", "Placement", "StateLayout", "StateView", "Task", "get_task"]

TASKS: dict[str, Task] = {
    module.TASK.name: module.TASK for module in (lamp_on, put_rubbish_in_bin, close_fridge, bimanual_lift_ball)
}


def get_task(name: str) -> Task:
    """The task of that name. Raises UserError with the nearest name where there is none."""
    if name not in TASKS:
        close = difflib.get_close_matches(name, TASKS, n=1)
        hint = f"did you mean {close[0]!r}?" if close else "see dsvla_jax.sim.tasks.TASKS."
        raise UserError(f"unknown task {name!r}: {hint} The tasks are {', '.join(TASKS)}.")
    return TASKS[name]
