"""The rows of the stages on a real arm, simulated. Importing it starts no simulator."""

from vla_eval.tasks.real_stages import CHANCE, COLORS, STAGES, Stage
from vla_eval.tasks.spec import TaskSpec

RESPONSE_STEPS = 160  # 8 s at 20 Hz: the expert lifts a cube in 2 to 3 s


def _row(stage: Stage) -> TaskSpec:
    steps = {
        phase: sum(one.twin_steps for one in stage.phases if one.phase == phase) for phase in ("cue", "delay")
    }
    return TaskSpec(
        id=stage.twin_id,
        entry_point="vla_eval.tasks.real_twin:RealTwinEnv",
        kwargs={"stage": stage.twin, **{f"{phase}_steps": number for phase, number in steps.items()}},
        horizon_steps=sum(steps.values()) + RESPONSE_STEPS,
        memory="object",
        instruction_key="RealTwin",
        instruction=stage.instruction,
        description=stage.description,
        success="The right cube has been lifted by 5 cm.",
        oracle="vla_eval.oracles.lift:CUBES",
        oracle_sees="poses of all cubes and which one is right; moves once the choice has appeared",
        candidates="cubes",
        candidate_counts={"n_items": len(COLORS)},
        cue_marks_place=stage.twin == "thrown_in",
        chance_success=CHANCE,
        suite="real_twin",
    )


REAL_TWIN = {row.id: row for row in map(_row, STAGES)}
"""Id -> row, in the paper's order."""
