"""A robot arm as an environment: when it may move, how far, what is marked, and that a fault stops it."""

from collections.abc import Callable

import numpy as np
import pytest

from tests.envs.robot_station import Bench
from vla_eval.envs.robot.link import RobotLink
from vla_eval.errors import (
    OperatorError,
    RobotBusError,
    RobotCameraError,
    RobotError,
    RobotTimingError,
)
from vla_eval.tasks.real_stages import STAGES


@pytest.mark.parametrize("stage", [stage.name for stage in STAGES])
def test_the_arm_is_held_still_in_all_phases_but_the_last(stage: str) -> None:
    bench = Bench(stage)
    bench.reset()
    began = list(bench.arm.motors)
    for phase in bench.trial.stage.phases[:-1]:
        for keys in ((), (), ("red", "picked", "done"), ("next",)):  # marks do not count yet
            if keys != ("next",):
                result = bench.step(*keys)
                assert result.status.phase == phase.phase
                assert result.status.touched_candidates == () and not result.status.is_over
                assert bench.arm.motors == began
        result = bench.step("next") if phase is not bench.trial.stage.phases[-2] else result
    assert bench.arm.motors == began
    if len(bench.trial.stage.phases) > 1:  # what was decided before the scene was revealed does not count
        assert bench.step("next").status.phase == "response"
        assert bench.arm.motors == began
    bench.step()
    assert bench.arm.motors != began


def test_a_motor_is_sent_no_further_than_a_step_from_where_it_is() -> None:
    bench = Bench(limits={"gripper": (0.0, 52.0)})
    bench.answer()
    draws = np.random.default_rng(3)
    for _ in range(25):
        before = np.array(bench.arm.motors)
        bench.step(action=draws.uniform(-300, 300, 3).tolist())
        assert np.abs(np.array(bench.arm.motors) - before).max() <= 5.0 + 1e-9
        assert 0.0 <= bench.arm.motors[2] <= 52.0


def test_the_executed_action_is_what_the_motors_were_sent() -> None:
    bench = Bench()
    bench.answer()
    before = np.array(bench.arm.motors)
    result = bench.step(action=[99.0, -99.0, float(before[2])])
    assert np.allclose(result.executed_action - before, (5.0, -5.0, 0.0))


def test_marks_are_touches_in_their_order_and_picking_is_success() -> None:
    bench = Bench()  # blue, index 2, is right
    bench.answer()
    status = bench.step("green").status
    assert (status.touched_candidates, status.first_choice, status.success) == ((1,), 1, False)
    status = bench.step("green", "picked").status
    assert (status.touched_candidates, status.success, status.n_wrong_choices) == ((1, 2), True, 1)
    assert (status.target, status.candidate_places, status.chance_success) == (2, (2, 0, 1), 1 / 3)
    assert not status.is_over
    assert bench.step("done").status.is_over


def test_the_response_ends_after_its_seconds() -> None:
    bench = Bench()
    bench.answer()
    ends = [bench.step().status.is_over for _ in range(30)]  # 3 s at 10 Hz
    assert ends == [False] * 29 + [True]


def test_a_policy_may_take_long_while_the_arm_is_held() -> None:
    bench = Bench(max_gap_seconds=1.0)
    bench.reset()
    bench.clock.sleep(30.0)
    bench.step()
    bench.clock.sleep(30.0)
    assert bench.step().status.phase == "cue"


def _late(bench: Bench) -> None:
    bench.clock.sleep(60.0)


FAULTS: dict[str, tuple[Callable[[Bench], object], type[RobotError], str]] = {
    "read": (lambda bench: bench.arm.fails.add("reading"), RobotBusError, "Check cables and power"),
    "command": (lambda bench: bench.arm.fails.add("commanding"), RobotBusError, "ConnectionError"),
    "nan": (lambda bench: bench.arm.changes.update({"lift.pos": float("nan")}), RobotBusError, "'lift'"),
    "no motor": (lambda bench: bench.arm.changes.update({"pan.pos": None}), RobotBusError, "'pan'"),
    "no image": (lambda bench: bench.arm.changes.update(front=None), RobotCameraError, "'front'"),
    "small image": (
        lambda bench: bench.arm.changes.update(front=np.zeros((2, 2, 3), dtype=np.uint8)),
        RobotCameraError,
        r"\(2, 2, 3\)",
    ),
    "frozen": (lambda bench: setattr(bench.arm, "is_frozen", True), RobotCameraError, "in a row"),
    "key": (lambda bench: setattr(bench.operator, "is_held", False), OperatorError, "dead man's key"),
    "abort": (lambda bench: bench.operator.waiting.append(["abort"]), OperatorError, "operator stopped"),
    "late": (_late, RobotTimingError, "max_gap_seconds"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_an_error_after_which_nothing_moves_until_the_next_episode(name: str) -> None:
    breaks, error, words = FAULTS[name]
    bench = Bench(stale_frames=4)
    bench.answer()
    bench.step()
    breaks(bench)
    n_before = len(bench.arm.sent)
    with pytest.raises(error, match=words):
        for _ in range(5):
            here, n_before = list(bench.arm.motors), len(bench.arm.sent)
            bench.step()
    # The one command of the step that failed, if it came so far, and one to stay where the arm was seen.
    assert len(bench.arm.sent) - n_before <= 2
    assert np.abs(np.array(bench.arm.motors) - here).max() <= 5.0 + 1e-9
    n_sent = len(bench.arm.sent)
    with pytest.raises(RobotError, match="moves again in the next episode"):
        bench.step()
    assert len(bench.arm.sent) == n_sent
    bench.arm.changes, bench.arm.is_frozen, bench.operator.is_held = {}, False, True
    bench.operator.waiting.clear()
    bench.link.reconnect()
    bench.answer()
    assert bench.step().status.phase == "response"


def test_an_operator_who_does_not_answer_is_an_error_and_the_arm_stays() -> None:
    bench = Bench()  # 2 s at 10 Hz
    began = list(bench.arm.motors)
    bench.reset()
    with pytest.raises(OperatorError, match=r"no answer for 2 s .*Cover the blue cube"):
        for _ in range(21):
            bench.step()
    assert bench.arm.motors == began


def test_the_arm_goes_home_in_small_steps_before_an_episode() -> None:
    bench = Bench()
    bench.arm.motors = [60.0, -20.0, 0.0]  # home is 10, -20, 50
    bench.reset()
    ways = np.diff([[60.0, -20.0, 0.0], *bench.arm.sent], axis=0)
    assert np.abs(ways).max() <= 5.0
    assert np.abs(np.array(bench.arm.motors) - [10.0, -20.0, 50.0]).max() <= 5.0


def test_the_table_is_set_when_the_arm_is_at_home() -> None:
    bench = Bench()
    bench.arm.motors = [60.0, -20.0, 0.0]
    places: list[list[float]] = []
    bench.operator.prepare = lambda trial: places.append(list(bench.arm.motors))  # type: ignore[method-assign]
    bench.reset()
    assert np.abs(np.array(places[0]) - [10.0, -20.0, 50.0]).max() <= 5.0


def test_a_home_that_is_named_is_where_episodes_begin() -> None:
    bench = Bench(home={"lift": 30.0})
    bench.reset()
    assert np.abs(np.array(bench.arm.motors) - [10.0, 30.0, 50.0]).max() <= 5.0


def test_an_arm_that_does_not_come_home_is_an_error_that_names_the_motor() -> None:
    bench = Bench()
    bench.arm.motors = [60.0, -20.0, 50.0]
    bench.arm.changes["pan.pos"] = 60.0  # it does not move
    with pytest.raises(RobotBusError, match=r"did not come home: .*'pan': -50\.0"):
        bench.reset()


def test_an_arm_without_a_calibration_is_refused() -> None:
    bench = Bench()
    bench.link.disconnect()
    bench.arm.is_calibrated = False
    with pytest.raises(RobotBusError, match="lerobot-calibrate"):
        bench.link.connect()


def test_a_robot_that_is_not_commanded_by_positions_is_refused() -> None:
    arm = Bench().arm
    arm.action_features = {"x.vel": float}
    with pytest.raises(RobotError, match=r"found x\.vel"):
        RobotLink(arm)
