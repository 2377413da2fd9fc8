"""MIKASA-Base among the tasks of the harness: a `TaskSpec` made of each of its rows."""

from vla_eval.base_tasks.catalog import BASE_TASKS
from vla_eval.base_tasks.row import BaseTask
from vla_eval.tasks.spec import TaskSpec


def _spec(row: BaseTask) -> TaskSpec:
    return TaskSpec(
        id=row.gym_id,
        version=row.version,
        entry_point=row.entry_point,
        horizon_steps=row.horizon_steps,
        memory=row.memory[0],
        other_memory=row.memory[1:],
        instruction_key="",
        instruction="",
        description=row.description,
        success=row.success or "",
        oracle=row.oracle,
        oracle_sees="what is hidden",
        candidates=None,
        chance_success=None,
        is_slow=row.is_slow,
        lacks=() if row.memoryless else ("memoryless",),
        suite="mikasa_base",
    )


MIKASA_BASE = {spec.id: spec for spec in map(_spec, BASE_TASKS.values())}
"""Task id -> its row."""
