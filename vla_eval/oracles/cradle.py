"""Expert for Intercept: wait next to the ball's lane, let the ball into the fingers, push it to the goal.

The gripper stays 3 cm open. Both fingers are aligned along y and hold the 4 cm ball like a cradle while
it is pushed in +x. The ball keeps its own speed along y, which decides where the arm meets it and how fast
it pushes: one row of `CradleTactics` per mode.

The controller acts on a model of arm and ball that is advanced step by step, for one action (closed loop)
or many (open loop). For the blind control, the ball exists only in the model.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vla_eval.oracles import arm_model as model
from vla_eval.task_state import PrivilegedState

HEIGHT_M = 0.022  # of the tool centre point while waiting and pushing: the ball's centre is at 0.02
BASE_X_M = -0.615
LANE_OFFSET_M = 0.065  # distance to the lane while waiting
FOLLOW_GAP_M = 0.05
CONTACT_GAP_M = 0.03
MEET_Y_EXTRA_M = 0.03
PUSH_SPEED_M_S = 0.47  # along x: the gap is closed at it, and the meeting point follows from it
PUSH_SPEED_RANGE_M_S = (0.2, 0.6)
MEET_Y_MIN_M = -0.5  # the arm does not wait farther back than this
TRACK_GAIN_PER_S = 6.0
SIDE_SPEED_CHANGE_M_S = 0.04  # per control step; a faster change lets the ball slip past a finger
FOLLOW_LEAD_S = 0.10
UNSEEN_STEPS = 6  # the ball is outside the base camera's view for so many steps: a nominal ball is assumed
GOAL_OFFSET_X_M = 0.2
ROLLING_SHARE = 5 / 7  # share of the initial speed that remains once a solid ball rolls without slipping
IMAGINED_Y_M = (-0.9, -0.65)
IMAGINED_VELOCITY_X_M_S = (0.0, 0.05)


@dataclass(frozen=True, slots=True, kw_only=True)
class CradleTactics:
    """Parameters that depend on the ball's speed; a call returns the expert of an episode."""

    # range of the initial speed along y, from which the blind arm draws its ball
    imagined_velocity_y_m_s: tuple[float, float]
    # the rolling ball's (x, y) velocity that is assumed while it is out of view
    nominal_velocity_m_s: tuple[float, float]
    # the arm does not wait closer to the base than this, where the inverse kinematics finds few low poses
    min_reach_m: float = 0.30
    # the gap is closed once ball and cradle are this close along y. An arm that is hardly faster
    # approaches so slowly that both would have passed the goal by then.
    aligned_m: float = 0.006

    def __call__(self, *, rng: np.random.Generator, imagined: bool) -> "CradleExpert":
        """Make an expert; with `imagined` it acts on a ball that it draws at random, not on the real one."""
        return CradleExpert(self, rng=rng, imagined=imagined)


SLOW = CradleTactics(
    imagined_velocity_y_m_s=(0.25, 0.5), nominal_velocity_m_s=(0.018, 0.268), min_reach_m=0.27
)
MEDIUM = CradleTactics(imagined_velocity_y_m_s=(0.5, 0.75), nominal_velocity_m_s=(0.018, 0.446))
FAST = CradleTactics(imagined_velocity_y_m_s=(0.75, 1.0), nominal_velocity_m_s=(0.018, 0.625), aligned_m=0.01)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Play:
    """State of the model: arm, ball in the plane of the table, and the controller's internal state."""

    tactics: CradleTactics
    arm: model.ArmState
    ball_m: model.Vector
    ball_velocity_m_s: model.Vector
    goal_m: model.Vector
    stage: str = "wait"  # `wait` next to the lane, `follow` the ball, `close` the gap, `push`
    side_speed_m_s: float = 0.0  # the commanded speed along y while pushing

    @property
    def gap_m(self) -> float:
        """How far the ball's centre is in front of the tool centre point."""
        return float(self.ball_m[0] - self.arm.position_m[0])


class CradleExpert:
    """One episode's expert; with `imagined` it acts on a ball drawn at random, not on the real one."""

    def __init__(self, tactics: CradleTactics, *, rng: np.random.Generator, imagined: bool) -> None:
        """Draw the imagined ball now, before the first observation."""
        self._tactics = tactics
        self._imagined = imagined
        self._stage = "wait"
        self._side_speed_m_s = 0.0
        self._drawn_y_m = rng.uniform(*IMAGINED_Y_M)
        self._drawn_velocity_m_s = np.array(
            [rng.uniform(*IMAGINED_VELOCITY_X_M_S), rng.uniform(*tactics.imagined_velocity_y_m_s)]
        )
        self._imagined_play: _Play | None = None

    def plan(self, state: PrivilegedState, step: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7), planned from this state alone (and, blind, from the imagined ball)."""
        play = self._present(state, step)
        rows = []
        for _ in range(n_actions):
            play = _decide(play)
            velocity = _command(play)
            rows.append(model.action_row(velocity / model.FULL_SPEED_M_S, model.GRIPPER_CRADLE))
            play = _advance(play, np.clip(velocity / model.FULL_SPEED_M_S, -1, 1))
        self._stage, self._side_speed_m_s = play.stage, play.side_speed_m_s
        self._imagined_play = play
        return np.stack(rows)

    def _present(self, state: PrivilegedState, step: int) -> _Play:
        goal = state.bodies["goal"].position_m[:2]
        if self._imagined:
            ball, velocity = self._imagined_ball(goal)
        elif step < UNSEEN_STEPS:
            velocity = np.array(self._tactics.nominal_velocity_m_s)
            ball = np.array([goal[0] - GOAL_OFFSET_X_M, np.mean(IMAGINED_Y_M)])
            ball = ball + velocity * step * model.STEP_SECONDS
        else:
            body = state.bodies["ball"]
            ball, velocity = body.position_m[:2], body.velocity_m_s[:2]
        return _Play(
            tactics=self._tactics,
            arm=model.arm_state(state),
            ball_m=ball,
            ball_velocity_m_s=velocity,
            goal_m=goal,
            stage=self._stage,
            side_speed_m_s=self._side_speed_m_s,
        )

    def _imagined_ball(self, goal_m: model.Vector) -> tuple[model.Vector, model.Vector]:
        """Return position and velocity of the imagined ball: as drawn, or as predicted by the model."""
        if self._imagined_play is None:
            start = np.array([goal_m[0] - GOAL_OFFSET_X_M, self._drawn_y_m])
            return start, self._drawn_velocity_m_s * ROLLING_SHARE
        return self._imagined_play.ball_m, self._imagined_play.ball_velocity_m_s


def _decide(play: _Play) -> _Play:
    tcp = play.arm.position_m
    behind_m = float(play.ball_m[1] - tcp[1])
    stage = play.stage
    if stage == "wait" and behind_m > -FOLLOW_LEAD_S * play.ball_velocity_m_s[1]:
        stage = "follow"
    if stage == "follow" and abs(behind_m) < play.tactics.aligned_m:
        stage = "close"
    if stage in ("follow", "close") and play.gap_m < CONTACT_GAP_M:
        return replace(play, stage="push", side_speed_m_s=float(play.ball_velocity_m_s[1]))
    return replace(play, stage=stage)


def _command(play: _Play) -> model.Vector:
    """Return the (3,) velocity in m/s that the controller commands in this stage."""
    tcp = play.arm.position_m
    height = model.POSITION_GAIN_PER_M * (HEIGHT_M - tcp[2]) * model.FULL_SPEED_M_S
    if play.stage == "wait":
        place = np.array([*_waiting_place_m(play), HEIGHT_M])
        velocity: model.Vector = model.POSITION_GAIN_PER_M * (place - tcp) * model.FULL_SPEED_M_S
        return np.clip(velocity, -model.FULL_SPEED_M_S, model.FULL_SPEED_M_S)
    tracking = TRACK_GAIN_PER_S * float(play.ball_m[1] - tcp[1])
    ball_v_x, ball_v_y = (float(v) for v in play.ball_velocity_m_s)
    if play.stage == "follow":
        keep_gap = TRACK_GAIN_PER_S * (play.gap_m - FOLLOW_GAP_M)
        return np.array([ball_v_x + keep_gap, ball_v_y + tracking, height])
    if play.stage == "close":
        return np.array([PUSH_SPEED_M_S, ball_v_y + tracking, height])
    forward, _ = _push_speeds_m_s(play)
    return np.array([forward, _next_side_speed_m_s(play) + tracking, height])


def lane_x_m(ball_m: model.Vector, velocity_m_s: model.Vector, y_m: float) -> float:
    """Return the x at which a ball's lane crosses `y_m`: its own x, if it does not roll along y."""
    x, y = (float(place) for place in ball_m)
    v_x, v_y = (float(v) for v in velocity_m_s)
    return x + v_x * (y_m - y) / v_y if v_y else x


def _waiting_place_m(play: _Play) -> model.Vector:
    """Return (x, y) next to the lane from which a push carries the ball to the goal."""
    lane_x = float(play.ball_m[0])
    v_y = float(play.ball_velocity_m_s[1])
    run_up_y = float(play.goal_m[0] - lane_x) * v_y / PUSH_SPEED_M_S + MEET_Y_EXTRA_M
    meet_y = max(float(play.goal_m[1]) - run_up_y, MEET_Y_MIN_M)
    x = lane_x_m(play.ball_m, play.ball_velocity_m_s, meet_y) - LANE_OFFSET_M
    from_base_x = x - BASE_X_M
    min_reach_m = play.tactics.min_reach_m
    if np.hypot(from_base_x, meet_y) < min_reach_m:
        meet_y = -np.sqrt(max(min_reach_m**2 - from_base_x**2, 0.0))
    return np.array([x, meet_y])


def _push_speeds_m_s(play: _Play) -> tuple[float, float]:
    """Return the forward and sideways speeds with which the ball reaches the goal along both axes at once."""
    to_goal_x, to_goal_y = (float(d) for d in play.goal_m - play.ball_m)
    side = play.side_speed_m_s
    wanted = to_goal_x * side / to_goal_y if abs(to_goal_y) > 1e-6 else PUSH_SPEED_RANGE_M_S[1]
    least, most = PUSH_SPEED_RANGE_M_S
    forward = min(max(wanted, least), most) if to_goal_y > 0 else most
    seconds = max(to_goal_x / forward, model.STEP_SECONDS)
    return forward, to_goal_y / seconds


def _next_side_speed_m_s(play: _Play) -> float:
    _, wanted = _push_speeds_m_s(play)
    change = min(max(wanted - play.side_speed_m_s, -SIDE_SPEED_CHANGE_M_S), SIDE_SPEED_CHANGE_M_S)
    return play.side_speed_m_s + change


def _advance(play: _Play, translation: model.Vector) -> _Play:
    """Return the model's state one control step later: the ball rolls, or moves with the cradle."""
    arm = model.advance(play.arm, translation)
    velocity = play.ball_velocity_m_s
    side_speed = play.side_speed_m_s
    if play.stage == "push":
        side_speed = _next_side_speed_m_s(play)
        velocity = arm.step_m[:2] / model.STEP_SECONDS
    return replace(
        play,
        arm=arm,
        ball_m=play.ball_m + velocity * model.STEP_SECONDS,
        ball_velocity_m_s=velocity,
        side_speed_m_s=side_speed,
    )
