"""The registry of tasks."""

from tom.envs.mujoco import TASKS, MujocoTask
from tom.errors import unknown

ENVS: dict[str, MujocoTask] = {task.name: task for task in TASKS}
ENV_NAMES: tuple[str, ...] = (*ENVS, "road-and-rocks")

__all__ = ["ENVS", "ENV_NAMES", "MujocoTask", "task"]


def task(name: str) -> MujocoTask:
    """The MuJoCo task called `name`; a UserError with the known names where there is none."""
    if name not in ENVS:
        raise unknown("environment", name, ENVS)
    return ENVS[name]
