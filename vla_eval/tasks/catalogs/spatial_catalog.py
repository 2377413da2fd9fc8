"""Rows of the tasks with a ball, a peg or a cube that moves: `catalog.py` adds them to all others.

Horizons and modes: the paper's table of tasks, and `docs/tasks.md`.
"""

import math
from typing import Any

from vla_eval.tasks.spec import TaskSpec

BALL_SPEEDS_M_S = {"Slow": (0.25, 0.5), "Medium": (0.5, 0.75), "Fast": (0.75, 1.0)}
IDLE_SUCCESS = {"Slow": 0.12}  # of 100 episodes: a slow ball can roll over the disc by itself
POSITIVE_RAD, EITHER_SIGN_RAD = (0.1, math.pi / 2), (0.1, math.pi / 4)


def _spatial(task: str, horizon_steps: int = 90, **row: Any) -> TaskSpec:  # Any: the other fields of a row
    """Return a row with the fields that all of them share: there are no candidates."""
    return TaskSpec(
        id=f"{task}-v0",
        horizon_steps=horizon_steps,
        memory="spatial",
        candidates=None,
        chance_success=None,
        **row,
    )


def _intercept(mode: str) -> TaskSpec:
    return _spatial(
        f"Intercept{mode}",
        entry_point="vla_eval.tasks.intercept:InterceptEnv",
        kwargs={"velocity_range_m_s": BALL_SPEEDS_M_S[mode]},
        instruction_key="InterceptMedium",
        description="A ball rolls across the table: deflect it so that it passes over the target disc.",
        success="The ball is within 10 cm of the target's centre, measured in the table's plane.",
        oracle=f"vla_eval.oracles.cradle:{mode.upper()}",
        seen_in_one_frame="ball",
        idle_success=IDLE_SUCCESS.get(mode, 0.0),
        oracle_sees="positions and velocity of ball and target, once the base camera could see the ball",
    )


def _intercept_grab(mode: str) -> TaskSpec:
    return _spatial(
        f"InterceptGrab{mode}",
        entry_point="vla_eval.tasks.intercept_grab:InterceptGrabEnv",
        kwargs={"velocity_range_m_s": BALL_SPEEDS_M_S[mode]},
        instruction_key="InterceptGrab",
        description="A ball rolls across the table: catch it with the gripper and come to rest.",
        success="Both fingers press the ball with at least 0.5 N and the arm is at rest.",
        oracle=f"vla_eval.oracles.catch:{mode.upper()}",
        seen_in_one_frame="ball",
        oracle_sees="position and velocity of the ball, once the base camera could see it",
    )


def _rotate(mode: str, *, strict: bool) -> TaskSpec:
    signed = mode == "PosNeg"
    rules = {"position_threshold_m": 0.05, "tilt_threshold_rad": 0.2} if strict else {}
    place = " without moving its middle" if strict else ""
    success = "The peg is within 0.1 rad of the angle asked for and the arm is at rest"
    return _spatial(
        f"Rotate{'Strict' if strict else 'Lenient'}{mode}",
        entry_point="vla_eval.tasks.rotate:RotateEnv",
        kwargs={"angle_range_rad": EITHER_SIGN_RAD if signed else POSITIVE_RAD, "signed": signed, **rules},
        instruction_key="RotateStrict" if strict else "RotateLenient",
        description=f"A peg lies on the table: turn it by the angle asked for{place}.",
        success=f"{success}; the peg's middle is within 5 cm of where it was, in x and in y."
        if strict
        else f"{success}.",
        oracle="vla_eval.oracles.turn:PEG_SIGNED" if signed else "vla_eval.oracles.turn:PEG",
        turns_wrist=True,
        oracle_sees="place and yaw of the peg, now and at the start, and the angle asked for",
    )


_TAKE_IT_BACK = _spatial(
    "TakeItBack",
    180,
    entry_point="vla_eval.tasks.take_it_back:TakeItBackEnv",
    instruction_key="TakeItBack",
    description=(
        "A cube lies on the table: move it onto the red disc and, when that turns violet, back to its place."
    ),
    success="The cube's middle was within 8 cm of the disc's, and is within 8 cm of its first place.",
    oracle="vla_eval.oracles.carry:CUBE",
    seen_in_one_frame="cube",
    oracle_sees="places of cube and disc, and the cube's first place, which it sees at the start",
)

SPATIAL_TASKS = (
    *(_intercept(mode) for mode in BALL_SPEEDS_M_S),
    *(_intercept_grab(mode) for mode in BALL_SPEEDS_M_S),
    *(_rotate(mode, strict=strict) for strict in (False, True) for mode in ("Pos", "PosNeg")),
    _TAKE_IT_BACK,
)
