"""Expert for TakeItBack: grasp the cube, drag it onto the disc, drag it back; also from single frames."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vla_eval.oracles import arm_model as model
from vla_eval.task_state import PrivilegedState

HOVER_M = 0.08
GRASP_M = 0.02
CARRY_M = 0.03  # off the table: no friction
BEHIND_M = 0.010  # grasp this far behind the cube's centre: the disc is at the edge of the arm's reach

OVER_M = 0.012
AT_GRASP_M = 0.008
CUBE_WIDTH_M = 0.04
HELD_WIDTH_M = 0.043
ON_DISC_M = 0.07  # within 8 cm counts
# The arm freezes if the inverse kinematics finds no pose for the target, up to 10 cm ahead, near the
# edge of its reach. If the arm stands still, the action is reduced step by step until it moves again.
STALLED_M_S = 0.03
CAUTION = 0.6
CAUTION_OF_ONE_FRAME = CAUTION**4  # it does not know how long the arm has stood still
AIM_M = 0.055  # the cube is moved this close to the disc's centre
BACK_M = 0.02
IMAGINED_X_M = (-0.05, 0.05)
IMAGINED_BANDS_Y_M = (-0.1, 0.0, 0.1)
IMAGINED_BAND_WIDTH_M = 0.05
MEAN_FIRST_X_M = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Play:
    """State of the model: arm, cube, the cube's target, and the controller's internal state."""

    arm: model.ArmState
    cube_m: model.Vector
    goal_m: model.Vector
    home_m: model.Vector
    was_there: bool
    closing: bool
    caution: float

    @property
    def held(self) -> bool:
        return self.closing and self.arm.width_m < HELD_WIDTH_M


class CarryExpert:
    """One episode's expert; with an imagined home it moves the cube back to that position."""

    def __init__(self, *, imagined_home_m: model.Vector | None) -> None:
        self._imagined_home_m = imagined_home_m
        self._was_there = False
        self._closing = False
        self._caution = 1.0

    def plan(self, state: PrivilegedState, step: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7), planned from this state and earlier ones."""
        home_m = state.bodies["first_place"].position_m[:2]
        play = _Play(
            arm=model.arm_state(state),
            cube_m=state.bodies["cube"].position_m[:2],
            goal_m=state.bodies["goal"].position_m[:2],
            home_m=home_m if self._imagined_home_m is None else self._imagined_home_m,
            was_there=self._was_there,
            closing=self._closing,
            caution=self._caution,
        )
        stalled = play.held and float(np.linalg.norm(state.tcp_velocity_m_s)) < STALLED_M_S
        self._caution = self._caution * CAUTION if stalled else 1.0
        play = replace(play, caution=self._caution)
        # Use only observed states: by the model alone, the arm would turn back too early.
        self._was_there |= float(np.linalg.norm(play.cube_m - play.goal_m)) < ON_DISC_M
        play = replace(play, was_there=self._was_there)
        self._closing = _decide(play).closing  # later steps are predictions of the model
        return _rows(play, n_actions)


def plan_from_one_frame(state: PrivilegedState, n_actions: int) -> NDArray[np.float32]:
    """Return (n_actions, 7), planned from this state alone: nothing is kept of earlier ones.

    The cube was dragged straight to the disc, and only until it was on it. So the way back is the line from
    the disc's centre through the cube, wherever on it the cube is. The disc's colour says which way to go.
    """
    arm = model.arm_state(state)
    cube_m, goal_m = (state.bodies[name].position_m[:2] for name in ("cube", "goal"))
    held = arm.width_m < HELD_WIDTH_M
    stalled = held and float(np.linalg.norm(state.tcp_velocity_m_s)) < STALLED_M_S
    play = _Play(
        arm=arm,
        cube_m=cube_m,
        goal_m=goal_m,
        home_m=_on_the_way_back_m(cube_m, goal_m),
        was_there=bool(state.bodies["violet_disc"].position_m[2] > 0),
        closing=held,
        caution=CAUTION_OF_ONE_FRAME if stalled else 1.0,
    )
    return _rows(play, n_actions)


def _on_the_way_back_m(cube_m: model.Vector, goal_m: model.Vector) -> model.Vector:
    """Return the place on the line from disc to cube that is as far from the robot as first places are."""
    offset_m = cube_m - goal_m
    times = (MEAN_FIRST_X_M - goal_m[0]) / min(float(offset_m[0]), -1e-3)
    place_m: model.Vector = goal_m + times * offset_m
    return place_m


def _rows(play: _Play, n_actions: int) -> NDArray[np.float32]:
    rows = []
    for _ in range(n_actions):
        play = _decide(play)
        translation, gripper = _command(play)
        rows.append(model.action_row(translation, gripper))
        play = _advance(play, translation, gripper)
    return np.stack(rows)


def _decide(play: _Play) -> _Play:
    over = float(np.linalg.norm(_grasp_place_m(play) - play.arm.position_m[:2])) < OVER_M
    low = abs(play.arm.position_m[2] - GRASP_M) < AT_GRASP_M
    return replace(play, closing=play.closing or (over and low))


def _grasp_place_m(play: _Play) -> model.Vector:
    place_m: model.Vector = play.cube_m - np.array([BEHIND_M, 0.0])
    return place_m


def _command(play: _Play) -> tuple[model.Vector, float]:
    arm = play.arm
    if not play.closing:
        place = _grasp_place_m(play)
        over = float(np.linalg.norm(place - arm.position_m[:2])) < OVER_M
        return model.towards(np.array([*place, GRASP_M if over else HOVER_M]), arm), model.GRIPPER_OPEN
    if not play.held:
        return np.zeros(3), model.GRIPPER_CLOSED
    shift = (play.home_m if play.was_there else play.goal_m) - play.cube_m
    distance = float(np.linalg.norm(shift))
    if play.was_there and distance < BACK_M:
        shift = np.zeros(2)
    elif not play.was_there:
        shift *= max(distance - AIM_M, 0.0) / max(distance, 1e-6)
    translation = model.towards(np.array([*(arm.position_m[:2] + shift), CARRY_M]), arm)
    return play.caution * translation, model.GRIPPER_CLOSED


def _advance(play: _Play, translation: model.Vector, gripper: float) -> _Play:
    """Return the model's state one control step later: a held object moves with the hand."""
    arm = model.advance_gripper(model.advance(play.arm, translation), 0.0, gripper, held_width_m=CUBE_WIDTH_M)
    moved = (arm.position_m - play.arm.position_m)[:2] if play.held else np.zeros(2)
    return replace(play, arm=arm, cube_m=play.cube_m + moved)


def carry_cube(*, rng: np.random.Generator, imagined: bool) -> CarryExpert:
    """Make the expert of an episode; the imagined first position is drawn before the first observation."""
    x, band = rng.uniform(*IMAGINED_X_M), IMAGINED_BANDS_Y_M[int(rng.integers(3))]
    home_m = np.array([x, band + rng.uniform(0, IMAGINED_BAND_WIDTH_M)])
    return CarryExpert(imagined_home_m=home_m if imagined else None)


CUBE = carry_cube
