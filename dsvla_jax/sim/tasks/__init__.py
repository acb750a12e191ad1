"""The manipulation tasks, by their RLBench names: every module of this package that has a ``TASK``."""

import difflib
import importlib
import pkgutil

from dsvla_jax.errors import UserError
from dsvla_jax.sim.tasks.task import Attachment, Graspable, Placement, StateLayout, StateView, Task, TaskObject

__all__ = [
    "TASKS",
    "Attachment",
    "Graspable",
    "Placement",
    "StateLayout",
    "StateView",
    "Task",
    "TaskObject",
    "get_task",
    "select_tasks",
]

_MODULES = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
_FOUND = [vars(module).get("TASK") for module in _MODULES]
TASKS: dict[str, Task] = {task.name: task for task in _FOUND if isinstance(task, Task)}


def get_task(name: str) -> Task:
    """The task of that name. Raises UserError with the nearest name where there is none."""
    if name not in TASKS:
        close = difflib.get_close_matches(name, TASKS, n=1)
        hint = f"did you mean {close[0]!r}?" if close else "see dsvla_jax.sim.tasks.TASKS."
        raise UserError(f"unknown task {name!r}: {hint} The tasks are {', '.join(TASKS)}.")
    return TASKS[name]


def select_tasks(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of tasks, with ``all``, ``single_arm`` and ``dual_arm`` and lists with commas spelled out, none twice.

    Raises UserError for an unknown name, or if there is none.
    """
    groups = {
        "all": tuple(TASKS),
        "single_arm": tuple(name for name, task in TASKS.items() if task.num_arms == 1),
        "dual_arm": tuple(name for name, task in TASKS.items() if task.num_arms == 2),
    }
    words = [word for name in names for word in name.split(",") if word]
    if not words:
        raise UserError(f"tasks: expected at least one name, got {' '.join(names)!r}; the tasks are {', '.join(TASKS)}")
    chosen = [name for word in words for name in groups.get(word, (word,))]
    return tuple(get_task(name).name for name in dict.fromkeys(chosen))
