"""`vla_eval.make_env`: a task as a Gymnasium environment."""

from collections.abc import Sequence
from typing import Any  # arguments of the task

from vla_eval.config.environment import WristMesh
from vla_eval.config.prompts import DEFAULT_PROMPT_SET
from vla_eval.control_modes import EE_DELTA_POSE
from vla_eval.envs.gymnasium_env import TaskEnv, make_task_env
from vla_eval.features import IMAGE_SIZE_PX
from vla_eval.tasks.interface import CAMERA_NAMES


def make_env(
    task: str,
    *,
    control_mode: str = EE_DELTA_POSE,
    image_size: int = IMAGE_SIZE_PX,
    cameras: Sequence[str] = CAMERA_NAMES,
    prompt_set: str = DEFAULT_PROMPT_SET,
    wrist_mesh: WristMesh = "shipped",
    render_backend: str = "auto",
    **env: Any,
) -> TaskEnv:
    """Return what `gymnasium.make("vla_eval/TASK", …)` makes, without Gymnasium's wrappers.

    Args:
        task: task id, a family with the arguments that it asks for, or a task of an installed package.
        control_mode: what an action means.
        image_size: height and width of images.
        cameras: which images an observation has; none: no renderer is started.
        prompt_set: where the instruction comes from.
        wrist_mesh: see `RenderSettings`.
        render_backend: likewise.
        **env: arguments of the task, `horizon_steps` among them, as `--set env.NAME` of an evaluation; and
            `simulator="fake"`.

    Raises:
        TaskArgumentError: the task does not take these arguments.
        UnknownNameError: there is no such task, argument, camera or control mode.
    """
    return make_task_env(
        task,
        control_mode=control_mode,
        image_size=image_size,
        cameras=cameras,
        prompt_set=prompt_set,
        wrist_mesh=wrist_mesh,
        render_backend=render_backend,
        **env,
    )
