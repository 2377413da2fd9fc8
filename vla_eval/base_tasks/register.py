"""Register MIKASA-Base with Gymnasium.

`import vla_eval.base_tasks.register`, then `gymnasium.make("mikasa_base/RepeatFirstEasy-v0")`.
"""

import gymnasium as gym

from vla_eval.base_tasks.catalog import BASE_TASKS

MAKE = "vla_eval.base_tasks.make:make_base_task"


def register_all() -> None:
    """Register what is not registered yet."""
    for row in BASE_TASKS.values():
        if row.gym_id not in gym.registry:
            gym.register(row.gym_id, entry_point=MAKE, kwargs={"name": row.name})


register_all()
