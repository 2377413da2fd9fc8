"""The rows of BunchOfColors, SeqOfColors and ChainOfColors. Importing it starts no simulator."""

from vla_eval.tasks.spec import MemoryType, TaskSpec, chance_of_several

N_CUBES = 9
HORIZON_STEPS = 120


def _several(family: str, memory: MemoryType, one_by_one: bool, in_order: bool, *, n_shown: int) -> TaskSpec:
    shown = "one after another" if one_by_one else "together"
    order = "in the order shown" if in_order else "in any order"
    return TaskSpec(
        id=f"{family}{n_shown}-v0",
        entry_point=f"vla_eval.tasks.sequences:{family}Env",
        kwargs={"n_shown": n_shown},
        horizon_steps=HORIZON_STEPS,
        memory=memory,
        instruction_key=family,
        description=(
            f"{n_shown} cubes of different colours are shown {shown}, the table is empty for a while, then "
            f"{N_CUBES} cubes lie there: touch those that were shown, {order}."
        ),
        success=(
            f"All cubes that were shown, and no other, have been touched {order}: the tool centre point was "
            "within 2 cm of the point 5 mm over the cube's top and the arm at rest."
        ),
        oracle="vla_eval.oracles.visit:CUBES",
        oracle_sees=(
            "poses of all cubes, which ones are right and which have been touched; moves once the choice "
            "has appeared"
        ),
        candidates="cubes",
        candidate_counts={"n_items": N_CUBES},
        several_right=True,
        chance_success=chance_of_several(N_CUBES, n_shown, in_order=in_order),
        shows_one_by_one=one_by_one,
    )


_FAMILIES: tuple[tuple[str, MemoryType, bool, bool], ...] = (
    # name, kind of memory, shown one by one, touched in order
    ("BunchOfColors", "capacity", False, False),
    ("SeqOfColors", "capacity", True, False),
    ("ChainOfColors", "sequential", True, True),
)
SEQUENCE_TASKS = tuple(_several(*family, n_shown=n) for family in _FAMILIES for n in (3, 5, 7))
