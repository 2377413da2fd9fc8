"""All task ids, one row each. Importing it starts no simulator.

Horizons, phases and instructions: the paper, appendix "VLA experiments", and `docs/tasks.md`.
"""

from vla_eval.errors import unknown_name
from vla_eval.tasks.spec import TaskSpec

_REMEMBER_SUCCESS = "The tool centre point is within 5 cm of the right item and the arm is at rest."


def _remember(
    task: str, entry: str, key: str, *, n_items: int, kwargs: dict[str, int], what: str
) -> TaskSpec:
    return TaskSpec(
        id=task,
        version=1,
        entry_point=f"vla_eval.tasks.remember:{entry}",
        kwargs=kwargs,
        horizon_steps=60,
        memory="object",
        instruction_key=key,
        description=f"An item is shown, the table is empty for a while, then {what}",
        success=_REMEMBER_SUCCESS,
        oracle="vla_eval.oracles.hover:CUBES",
        oracle_sees="poses of all items and which one is right; moves once the choice has appeared",
        candidates="items",
        chance_success=1 / n_items,
        max_reward=3.0,
    )


_REMEMBER = (
    *(
        _remember(
            f"RememberColor{n}-v0",
            "RememberColorEnv",
            "RememberColor",
            n_items=n,
            kwargs={"n_items": n},
            what=f"{n} cubes of different colours lie there: reach the one that has the colour shown.",
        )
        for n in (3, 5, 9)
    ),
    *(
        _remember(
            f"RememberShape{n}-v0",
            "RememberShapeEnv",
            "RememberShape",
            n_items=n,
            kwargs={"n_items": n},
            what=f"{n} blue items of different shapes lie there: reach the one that has the shape shown.",
        )
        for n in (3, 5, 9)
    ),
    *(
        _remember(
            f"RememberShapeAndColor{shapes}x{colors}-v0",
            "RememberShapeAndColorEnv",
            "RememberShapeAndColor",
            n_items=shapes * colors,
            kwargs={"n_shapes": shapes, "n_colors": colors},
            what=f"items of {shapes} shapes in {colors} colours lie there: reach the one that was shown.",
        )
        for shapes, colors in ((3, 2), (3, 3), (5, 3))
    ),
)

TASKS: dict[str, TaskSpec] = {
    spec.id: spec
    for spec in (
        *_REMEMBER,
        TaskSpec(
            id="ShellGameTouch-v0",
            version=1,
            entry_point="vla_eval.tasks.shell_game:ShellGameTouchEnv",
            horizon_steps=90,
            memory="object",
            instruction_key="ShellGameTouch",
            description=(
                "A ball lies at one of three places, then a mug stands on each of them: reach the mug "
                "that hides the ball."
            ),
            success="The tool centre point is within 8 cm of the right mug and the arm is at rest.",
            oracle="vla_eval.oracles.hover:MUGS",
            oracle_sees="poses of all mugs and which one is right; moves once the mugs have appeared",
            candidates="mugs",
            chance_success=1 / 3,
            max_reward=3.0,
        ),
        TaskSpec(
            id="InterceptMedium-v0",
            version=1,
            entry_point="vla_eval.tasks.intercept:InterceptEnv",
            kwargs={"velocity_range_m_s": (0.5, 0.75)},
            horizon_steps=90,
            memory="spatial",
            instruction_key="InterceptMedium",
            description="A ball rolls across the table: deflect it so that it passes over the target disc.",
            success="The ball is within 10 cm of the target's centre, measured in the table's plane.",
            oracle="vla_eval.oracles.cradle:CradleExpert",
            oracle_sees="positions and velocity of ball and target, once the base camera could see the ball",
            candidates=None,
            chance_success=None,
            max_reward=30.0,
        ),
    )
}


def task_spec(task_id: str) -> TaskSpec:
    """Return the row of a task.

    Args:
        task_id: `RememberColor3-v0`, with or without the `vla_eval/` namespace.

    Raises:
        UnknownNameError: there is no such task; the message suggests the closest one.
    """
    name = task_id.removeprefix("vla_eval/")
    if name not in TASKS:
        raise unknown_name("task", name, TASKS)
    return TASKS[name]
