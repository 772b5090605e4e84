"""The registry of tasks: our own, those of plug-ins, and any of Gymnasium's by `module:Id`."""

import re
from collections.abc import Callable, Iterable
from functools import cache

from tom.envs.gymnasium_task import OWN, GymnasiumTask, describe
from tom.envs.mujoco import TASKS, MujocoTask
from tom.envs.task import Task, Termination
from tom.errors import UserError, unknown

ROAD = "road-and-rocks"
ENVS: dict[str, MujocoTask] = {task.name: task for task in TASKS}
ENV_NAMES: tuple[str, ...] = (*ENVS, ROAD)
OTHERS: dict[str, Callable[[], Task]] = {}
"""tasks of plug-ins and of modules that the user named; each is made on first use"""
VERSIONED = re.compile(r"-v[0-9]+$")
"""how names of Gymnasium end"""
ANY = "or any Gymnasium task: gymnasium:Swimmer-v5, my_package:MyTask-v0"

__all__ = [
    "ANY", "ENVS", "ENV_NAMES", "OTHERS", "ROAD", "GymnasiumTask", "MujocoTask", "Task",
    "Termination", "import_task", "imported_tasks", "is_code", "is_known", "task", "task_rank",
    "unknown_task",
]  # fmt: skip


def task(name: str) -> Task:
    """The task called `name`. Imports no module of the user; that is done by `import_task`.

    Raises UserError with the known names if there is none.
    """
    if name in ENVS:
        return ENVS[name]
    if name in OTHERS:
        return OTHERS[name]()
    module, colon, _ = name.partition(":")
    if module == OWN and colon:
        return _of_gymnasium(name)
    if colon:
        raise UserError(
            f"task {name} is code of the module '{module}', which is imported where you name it "
            f"alone: add --env {name}"
        )
    raise unknown_task(name, ENVS)


def unknown_task(name: str, ours: Iterable[str]) -> UserError:
    """The error for a name that is no task's; `ours` are those of our own that could be meant."""
    if VERSIONED.search(name):
        return UserError(f"unknown environment '{name}': a task of Gymnasium is {OWN}:{name}")
    return UserError(f"{unknown('environment', name, (*ours, *OTHERS))}, {ANY}")


def import_task(name: str | None) -> None:
    """Import the module of a task that the user names, and register the task.

    The module is code that the user chose to run. Raises UserError if this fails.
    """
    if name is None or name in OTHERS or not is_code(name):
        return
    known = describe(name)
    OTHERS[name] = lambda: known


def imported_tasks() -> list[str]:
    """The tasks whose modules the user named to this process."""
    return [name for name in OTHERS if is_code(name)]


def task_rank(name: str) -> tuple[int, str]:
    """The place of a task in a table: ours as in the registry, then others by name."""
    return (ENV_NAMES.index(name) if name in ENV_NAMES else len(ENV_NAMES)), name


def is_code(name: str) -> bool:
    """Whether the task's module has to be imported; Gymnasium's own is always imported."""
    module, colon, _ = name.partition(":")
    return bool(colon) and module != OWN


def is_known(name: str) -> bool:
    """Whether `name` is one of our tasks, a plug-in's, or one whose module was imported."""
    return name in ENV_NAMES or name in OTHERS or ":" in name


_of_gymnasium = cache(describe)
