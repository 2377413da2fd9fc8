"""A task on the CPU simulator, without a renderer and without a reward."""

from typing import Any

from vla_eval.envs.scenes import share_vulkan
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.register import env_class


def make(task: str, **kwargs: Any) -> Any:
    spec = task_spec(task)
    settings = {
        "obs_mode": "none",
        "reward_mode": "none",
        "control_mode": "pd_ee_delta_pose",
        "render_backend": "none",
        **spec.kwargs,
        **kwargs,
    }
    share_vulkan(settings["render_backend"])  # half of the time of a reset
    return env_class(spec)(**settings)
