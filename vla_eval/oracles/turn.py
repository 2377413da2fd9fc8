"""Expert for Rotate: grasp the peg at its centre and rotate it in place.

The fingers grasp across the peg, so two grasps are possible, half a turn apart. The one with the shorter
total rotation is used. The wrist already turns during the descent. Turning is the slow part: at most
0.039 rad per control step.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vla_eval.oracles import arm_model as model
from vla_eval.task_state import PrivilegedState

# Joint 7 starts at π/4 and its range is ±2.9 rad: the wrist can turn farther to the left than to the right.
WRIST_RANGE_RAD = (-1.95, 3.4)
HOVER_M = 0.10
GRASP_M = 0.022
OVER_M = 0.015  # the arm descends within this horizontal distance of the peg's centre,
DESCEND_RAD = 0.35  # once the fingers are aligned to this angle: 8 cm between them leave room around 5 cm,
CLOSE_RAD = 0.12  # and closes once they are aligned to this angle
AT_GRASP_M = 0.008
# Of full speed: faster, the arm swerves by 1 cm per step, which an open-loop plan cannot correct.
DESCENT = 0.5
PEG_WIDTH_M = 0.05
HELD_WIDTH_M = 0.052
AT_ANGLE_RAD = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class _Play:
    """State of the model: arm, peg, and the peg's target.

    `may_descend` is observed, not predicted: the arm descends only if it is really over the peg when the
    plan is made. If it moved there and down in one plan, it would sometimes hit the peg.
    """

    arm: model.ArmState
    peg_m: model.Vector
    peg_yaw_rad: float
    goal_m: model.Vector
    grasp_yaw_rad: float
    left_rad: float
    closing: bool
    may_descend: bool = False


class TurnExpert:
    """One episode's expert; with `imagined` it turns the peg by an angle drawn at random."""

    def __init__(self, *, imagined_angle_rad: float | None) -> None:
        self._imagined_angle_rad = imagined_angle_rad
        self._goal_yaw_rad: float | None = None
        self._grasp_offset_rad: float | None = None
        self._closing = False

    def plan(self, state: PrivilegedState, step: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7), planned from this state and the grasp chosen at the start."""
        play = self._present(state)
        rows = []
        for index in range(n_actions):
            play = _decide(play)
            if index == 0:
                self._closing = play.closing
            translation, turn, gripper = _command(play)
            rows.append(model.action_row(translation, gripper, turn))
            play = _advance(play, translation, turn, gripper)
        return np.stack(rows)

    def _present(self, state: PrivilegedState) -> _Play:
        arm = model.arm_state(state)
        peg, goal = state.bodies["peg"], state.bodies["goal"]
        if self._goal_yaw_rad is None:
            by_rad = self._imagined_angle_rad
            self._goal_yaw_rad = goal.yaw_rad if by_rad is None else peg.yaw_rad + by_rad
        left_rad = model.wrapped_rad(self._goal_yaw_rad - peg.yaw_rad)
        if self._grasp_offset_rad is None:
            grasp_yaw_rad = _grasp_yaw_rad(arm.yaw_rad, peg.yaw_rad, left_rad)
            self._grasp_offset_rad = grasp_yaw_rad - peg.yaw_rad
        # Unwrapped around the wrist's own yaw: the direction was chosen with the grasp.
        wanted_rad = peg.yaw_rad + self._grasp_offset_rad
        play = _Play(
            arm=arm,
            peg_m=peg.position_m,
            peg_yaw_rad=peg.yaw_rad,
            goal_m=goal.position_m,
            grasp_yaw_rad=arm.yaw_rad + model.wrapped_rad(wanted_rad - arm.yaw_rad),
            left_rad=left_rad,
            closing=self._closing,
        )
        return replace(play, may_descend=_is_over(play))


def _grasp_yaw_rad(wrist_rad: float, peg_rad: float, left_rad: float) -> float:
    """Return the wrist's yaw of the grasp with the shortest rotation within the wrist's range."""
    nearest = wrist_rad + model.wrapped_rad(peg_rad - wrist_rad, math.pi)
    least, most = WRIST_RANGE_RAD

    def way(yaw_rad: float) -> tuple[bool, float]:
        ends = (yaw_rad, yaw_rad + left_rad)
        return max(ends) > most or min(ends) < least, abs(yaw_rad - wrist_rad)

    return min((nearest, nearest + math.pi, nearest - math.pi), key=way)


def _decide(play: _Play) -> _Play:
    """Close the fingers, permanently, if they are around the peg."""
    around = _over_m(play) < OVER_M and abs(play.arm.position_m[2] - GRASP_M) < AT_GRASP_M
    aligned = abs(play.grasp_yaw_rad - play.arm.yaw_rad) < CLOSE_RAD
    return replace(play, closing=play.closing or (around and aligned))


def _over_m(play: _Play) -> float:
    return float(np.linalg.norm((play.peg_m - play.arm.position_m)[:2]))


def _is_over(play: _Play) -> bool:
    """Whether the fingers would be on both sides of the peg if they moved down."""
    return _over_m(play) < OVER_M and abs(play.grasp_yaw_rad - play.arm.yaw_rad) < DESCEND_RAD


def _command(play: _Play) -> tuple[model.Vector, float, float]:
    arm = play.arm
    if not play.closing:
        down = play.may_descend and _is_over(play)
        goal = np.array([*play.peg_m[:2], GRASP_M if down else HOVER_M])
        translation = model.towards(goal, arm)
        if down:
            translation[2] = max(translation[2], -DESCENT)
        return translation, model.turn_towards(play.grasp_yaw_rad, arm), model.GRIPPER_OPEN
    held = arm.width_m < HELD_WIDTH_M
    # Move the centre back to its first position, in case the grasp has moved it.
    shift = (play.goal_m - play.peg_m)[:2] if held else np.zeros(2)
    goal = np.array([*(arm.position_m[:2] + shift), GRASP_M])
    turns = held and abs(play.left_rad) > AT_ANGLE_RAD
    turn = model.turn_towards(arm.yaw_rad + play.left_rad, arm) if turns else 0.0
    return model.towards(goal, arm), turn, model.GRIPPER_CLOSED


def _advance(play: _Play, translation: model.Vector, turn: float, gripper: float) -> _Play:
    """Return the model's state one control step later: a held object turns and moves with the hand."""
    held = play.closing and play.arm.width_m < HELD_WIDTH_M
    arm = model.advance_gripper(model.advance(play.arm, translation), turn, gripper, held_width_m=PEG_WIDTH_M)
    if not held:
        return replace(play, arm=arm)
    turned_rad = arm.yaw_rad - play.arm.yaw_rad
    moved = arm.position_m - play.arm.position_m
    return replace(
        play,
        arm=arm,
        peg_m=play.peg_m + moved,
        peg_yaw_rad=play.peg_yaw_rad + turned_rad,
        grasp_yaw_rad=play.grasp_yaw_rad + turned_rad,
        left_rad=play.left_rad - turned_rad,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PegTurns:
    """Makes the expert of an episode."""

    # range from which the blind arm's angle is drawn; `signed`: whether it has a sign
    angle_range_rad: tuple[float, float]
    signed: bool

    def __call__(self, *, rng: np.random.Generator, imagined: bool) -> TurnExpert:
        """Draw the imagined angle now, before the first observation."""
        angle_rad = rng.uniform(*self.angle_range_rad)
        sign = -1.0 if self.signed and rng.integers(2) else 1.0
        return TurnExpert(imagined_angle_rad=sign * angle_rad if imagined else None)


PEG = PegTurns(angle_range_rad=(0.1, math.pi / 2), signed=False)
PEG_SIGNED = PegTurns(angle_range_rad=(0.1, math.pi / 4), signed=True)
