"""The laws of the scripted experts, without a simulator."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from vla_eval.oracles import carry, catch, cradle, turn
from vla_eval.oracles.arm_model import action_row, wrapped_rad
from vla_eval.task_state import BodyState, PrivilegedState

ZERO = np.zeros(3)
BALL_TACTICS = (cradle.SLOW, cradle.MEDIUM, cradle.FAST, catch.SLOW, catch.MEDIUM, catch.FAST)
SPEEDS_M_S = (
    0.0,
    5e-324,
    1e-9,
    0.5,
    -1e-9,
    -0.5,
)  # at rest, asleep but for a rounding, rolling, rolling back


def still(**bodies: BodyState) -> PrivilegedState:
    """An arm at rest at its starting place, gripper open."""
    return PrivilegedState(
        phase="response",
        response_step=0,
        tcp_position_m=np.array([-0.07, 0.0, 0.318]),
        tcp_velocity_m_s=ZERO,
        gripper_width_m=0.08,
        candidate_positions_m=np.zeros((0, 3)),
        bodies=bodies,
    )


def body(x: float, y: float, z: float = 0.02, *, yaw_rad: float = 0.0, v_y: float = 0.0) -> BodyState:
    return BodyState(position_m=np.array([x, y, z]), velocity_m_s=np.array([0.0, v_y, 0.0]), yaw_rad=yaw_rad)


def test_an_action_without_turn_has_the_bytes_of_plain_zeros() -> None:
    # -0.0 equals 0.0, but trajectories are compared by digests of their bytes.
    assert action_row(np.ones(3), 1.0).tobytes() == np.array([1, 1, 1, 0, 0, 0, 1], np.float32).tobytes()


@pytest.mark.parametrize(
    ("angle", "period", "expected"),
    [
        (math.pi * 1.5, 2 * math.pi, -math.pi / 2),
        (-3.5, 2 * math.pi, 2 * math.pi - 3.5),
        (math.pi * 0.75, math.pi, -math.pi / 4),
        (0.2, math.pi, 0.2),
    ],
)
def test_angles_are_wrapped_into_one_period_around_zero(angle: float, period: float, expected: float) -> None:
    assert wrapped_rad(angle, period) == pytest.approx(expected)


@pytest.mark.parametrize("left_rad", [-math.pi / 4, -0.1, 0.1, 0.8, math.pi / 2])
@pytest.mark.parametrize("peg_rad", np.linspace(-3.1, 3.1, 9).tolist())
def test_a_peg_is_grasped_across_and_the_whole_turn_is_within_the_wrist_s_range(
    peg_rad: float, left_rad: float
) -> None:
    yaw_rad = turn._grasp_yaw_rad(0.0, peg_rad, left_rad)
    assert wrapped_rad(yaw_rad - peg_rad, math.pi) == pytest.approx(0, abs=1e-9)
    least, most = turn.WRIST_RANGE_RAD
    assert least <= yaw_rad <= most and least <= yaw_rad + left_rad <= most


def test_the_shorter_of_two_possible_grasps_is_taken() -> None:
    # A peg at 170° lies as one at -10°: 10° are nearer than 170°.
    assert turn._grasp_yaw_rad(0.0, math.radians(170), 0.5) == pytest.approx(math.radians(-10))


def test_a_blind_arm_turns_the_peg_whatever_angle_is_asked_for() -> None:
    def first_turns(asked_rad: float, imagined: bool) -> float:
        peg = body(0.0, 0.0, yaw_rad=0.3)
        goal = body(0.0, 0.0, yaw_rad=0.3 + asked_rad)
        expert = turn.PEG_SIGNED(rng=np.random.default_rng(1), imagined=imagined)
        # The arm holds the peg: what it does next shows which way it means to turn it.
        expert._closing = True
        held = replace(
            still(peg=peg, goal=goal), gripper_width_m=0.05, tcp_position_m=np.array([0, 0, 0.022])
        )
        return float(expert.plan(held, 0, 1)[0, 5])

    # The sign of rotations is the other way round in this control mode.
    assert first_turns(0.5, imagined=False) < 0 < first_turns(-0.5, imagined=False)
    assert first_turns(0.5, imagined=True) == first_turns(-0.5, imagined=True) != 0


def test_the_cube_is_brought_back_only_after_it_was_on_the_disc() -> None:
    def push_x(cube_x: float) -> float:
        expert = carry.CUBE(rng=np.random.default_rng(1), imagined=False)
        expert._closing = True
        bodies = {"cube": body(cube_x, 0), "goal": body(0.22, 0), "first_place": body(0, 0)}
        held = replace(still(**bodies), gripper_width_m=0.04, tcp_position_m=np.array([cube_x, 0, 0.03]))
        return float(expert.plan(held, 0, 1)[0, 0])

    assert push_x(0.05) > 0 > push_x(0.20)


def acts(tactics: Any, state: PrivilegedState, *, imagined: bool = False) -> None:
    """Check that an expert has actions for a state, at the first look at it and later ones."""
    expert = tactics(rng=np.random.default_rng(1), imagined=imagined)
    for step in (0, 20, 40):
        rows = expert.plan(state, step, 16)
        assert np.isfinite(rows).all() and np.abs(rows).max() <= 1


@pytest.mark.parametrize(("v_x", "v_y"), list(itertools.product(SPEEDS_M_S, repeat=2)))
@pytest.mark.parametrize("tactics", BALL_TACTICS)
def test_there_is_an_action_whatever_the_ball_does(
    tactics: cradle.CradleTactics, v_x: float, v_y: float
) -> None:
    for x, y in ((-0.2, -0.4), (-0.07, 0.0), (0.0, 0.0), (5.0, 9.0)):  # in its lane, at the hand, far away
        ball = BodyState(
            position_m=np.array([x, y, 0.02]), velocity_m_s=np.array([v_x, v_y, 0.0]), yaw_rad=0.0
        )
        for imagined in (False, True):
            acts(tactics, still(ball=ball, goal=body(0.0, 0.0)), imagined=imagined)


@pytest.mark.parametrize("imagined", [False, True])
@pytest.mark.parametrize("make", [carry.CUBE, turn.PEG, turn.PEG_SIGNED])
def test_there_is_an_action_where_all_things_are_in_one_place(make: Any, imagined: bool) -> None:
    for x, y in ((0.0, 0.0), (-0.07, 0.0), (-0.615, 0.0), (5.0, 9.0)):
        here = body(x, y)
        acts(make, still(cube=here, goal=here, first_place=here, peg=here), imagined=imagined)


@pytest.mark.parametrize("tactics", BALL_TACTICS)
def test_a_ball_that_cannot_be_seen_yet_changes_nothing(tactics: cradle.CradleTactics) -> None:
    plans = []
    for start_y in (-0.9, -0.65):
        expert = tactics(rng=np.random.default_rng(1), imagined=False)
        state = still(ball=body(-0.2, start_y, v_y=0.5), goal=body(0.0, 0.0))
        plans.append(expert.plan(state, 0, 4))
    assert np.array_equal(plans[0], plans[1])


@pytest.mark.parametrize("tactics", [cradle.SLOW, cradle.FAST, catch.SLOW, catch.FAST])
def test_a_blind_arm_does_not_see_the_ball(tactics: cradle.CradleTactics) -> None:
    plans = []
    for y in (-0.3, 0.1):
        expert = tactics(rng=np.random.default_rng(1), imagined=True)
        state = still(ball=body(-0.2, y, v_y=0.5), goal=body(0.0, 0.0))
        plans.append(expert.plan(state, 20, 4))
    assert np.array_equal(plans[0], plans[1])


def test_the_hand_flies_with_the_ball_before_it_comes_down() -> None:
    expert = catch.MEDIUM(rng=np.random.default_rng(1), imagined=False)
    y = catch.MEDIUM.meet_y_m
    over = np.array([-0.2, y, catch.HOVER_M])
    behind = replace(still(ball=body(-0.2, y - 0.1, v_y=0.4)), tcp_position_m=over)
    assert np.abs(expert.plan(behind, 20, 1)[0, :3]).max() < 0.1  # 10 cm behind: the hand waits
    below = replace(still(ball=body(-0.2, y, v_y=0.4)), tcp_position_m=over)
    row = expert.plan(below, 21, 1)[0]
    assert row[1] > 0.4 and row[2] < 0 and row[6] == 1  # 0.4 m/s of 0.78, downwards, open
