"""Units, the watchdog's parts, the operator's keys, and what may stand in a robot's file."""

import os
import pty
from pathlib import Path

import numpy as np
import pytest

from vla_eval.config.real_robot import SIMULATED, JointZero, RobotSettings, load_robot
from vla_eval.envs.robot.keys import KeysOperator
from vla_eval.envs.robot.operators import KEYS
from vla_eval.envs.robot.units import Units
from vla_eval.envs.robot.watch import CameraWatch, StepClock
from vla_eval.errors import OperatorError, RecipeError, RobotCameraError, UnknownNameError
from vla_eval.robots.rows import SO100
from vla_eval.tasks.real_stages import STAGES, Trial


def test_an_action_made_of_motors_sends_them_back_there() -> None:
    draws = np.random.default_rng(1)
    joints = [SO100.joints[index] for index in SO100.arm_joints]
    for _ in range(50):
        signs, zeros = draws.choice([-1, 1], 5).tolist(), draws.uniform(-40, 40, 5).tolist()
        pairs = zip(joints, signs, zeros, strict=True)
        settings = RobotSettings(
            lerobot={"type": "so101_follower"},
            control_mode="pd_joint_pos",
            zeros={name: JointZero(sign=sign, zero_deg=zero) for name, sign, zero in pairs},
        )
        units = Units.of(settings, SO100.joints)
        motors = np.array([*draws.uniform(-90, 90, 5), draws.uniform(0, 100)])
        assert np.allclose(units.goal(units.action_of(motors)), motors, atol=1e-3)
        # By hand: 30 degrees beyond the zero of a reversed joint are -30 degrees of the model's.
        turned = motors.copy()
        turned[0] = zeros[0] + 30.0
        qpos = units.state(turned, turned, control_hz=20)["qpos"]
        assert np.isclose(qpos[0], signs[0] * np.pi / 6, atol=1e-5)


def test_motors_are_given_as_they_are_and_velocities_are_differences() -> None:
    units = Units.of(SIMULATED, SO100.joints)
    before, now = np.zeros(6), np.array([9.0, 0, 0, 0, 0, 0])
    state = units.state(now, before, control_hz=20)
    assert state["motors"].tolist() == now.tolist()
    assert np.isclose(state["qvel"][0], np.radians(9) * 20, atol=1e-5)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"limits": {"elbo_flex": (0.0, 1.0)}}, "Did you mean 'elbow_flex'"),
        ({"zeros": {"shoulder_pan": JointZero(sign=1, zero_deg=0.0)}}, "shoulder_lift"),
        ({"lerobot": {"type": "koch_follower"}, "zeros": SIMULATED.zeros}, "koch_follower"),
    ],
)
def test_limits_and_zeros_are_of_motors_that_are_there(fields: dict[str, object], words: str) -> None:
    settings = RobotSettings(**{"lerobot": {"type": "so101_follower"}, **fields})  # type: ignore[arg-type]
    with pytest.raises((UnknownNameError, RecipeError), match=words):
        Units.of(settings, SO100.joints)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("lerobot: {port: x}", "lerobot.type"),
        ("lerobot: {type: a}\nmax_stp: 3", "Did you mean 'max_step'"),
        ("lerobot: {type: a}\nmax_step: 0", "max_step"),
        ("lerobot: {type: a}\ncontrol_mode: pd_joint_pos", "`zeros` is missing"),
        ("lerobot: {type: a}\nlimits: {pan: [3, 1]}", "limits.pan"),
        ("lerobot: {type: simulated_so100}", "control_hz"),
        ("just text", "expected fields"),
    ],
)
def test_a_robots_file_is_read_strictly(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    path.write_text(text)
    with pytest.raises(RecipeError, match=words):
        load_robot(str(path))


def test_a_robots_file_gives_its_settings_and_addresses_are_no_part_of_what_results_depend_on(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bench_3.yaml"
    text = (
        "lerobot: {type: so101_follower, port: /dev/ttyACM0, id: bench_3, "
        "cameras: {front: {type: opencv, index_or_path: 0, fps: 30}}}\n"
        "control_mode: pd_joint_pos\nlimits: {gripper: [0, 90]}\n"
        "zeros: {shoulder_pan: {sign: -1, zero_deg: 2}}\n"
    )
    path.write_text(text)
    settings = load_robot(str(path))
    assert settings.type == "so101_follower"
    assert settings.limits == {"gripper": (0.0, 90.0)}
    assert settings.zeros == {"shoulder_pan": JointZero(sign=-1, zero_deg=2.0)}

    path.write_text(text.replace("ACM0", "ACM1").replace("index_or_path: 0", "index_or_path: 2"))
    elsewhere = load_robot(str(path))
    assert elsewhere.lerobot["port"] == "/dev/ttyACM1" and elsewhere.content == settings.content
    path.write_text(text.replace("id: bench_3", "id: bench_4"))
    assert load_robot(str(path)).content != settings.content


def test_a_mistyped_robot_gets_a_suggestion() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'simulated_so100'"):
        load_robot("simulated_so10")


def test_a_camera_is_frozen_after_so_many_images_that_are_the_same_to_the_last_byte() -> None:
    watch = CameraWatch(stale_frames=3)
    images = [np.full((2, 2, 3), level, dtype=np.uint8) for level in (1, 1, 2, 2, 1)]
    for image in images:  # never three in a row
        watch.check({"front": image, "wrist": image + len(images)})
    watch.check({"front": images[-1]})
    with pytest.raises(RobotCameraError, match=r"camera 'front'.* 3 times"):
        watch.check({"front": images[-1]})


class Terminal:
    """A terminal, its person, and a clock that stands still."""

    def __init__(self) -> None:
        self.person, self.descriptor = pty.openpty()
        self.clock, self.said = StepClock(), list[str]()
        self.answers: list[str] = []  # typed when something is said
        settings = RobotSettings(lerobot={"type": "a"}, dead_man_seconds=1.5, operator_seconds=300)
        self.operator = KeysOperator(settings, self.clock, descriptor=self.descriptor, say=self.say)

    def type(self, text: str) -> None:
        os.write(self.person, text.encode())

    def say(self, words: str) -> None:
        self.said.append(words)
        if self.answers:
            self.type(self.answers.pop(0))


def test_each_key_has_a_meaning_and_unknown_ones_have_none() -> None:
    terminal = Terminal()
    with terminal.operator as operator:
        terminal.type("".join(key.character for key in KEYS) + "qQ9R")
        expected = [key.means for key in KEYS if key.means != "hold"] + ["red"]
        assert list(operator.pressed()) == expected
        assert list(operator.pressed()) == []


def test_the_arm_may_move_only_for_a_moment_after_a_key() -> None:
    terminal = Terminal()
    with terminal.operator as operator:
        assert not operator.lets_move()
        terminal.type(" ")
        assert operator.lets_move()
        terminal.clock.sleep(1.4)
        assert operator.lets_move()
        terminal.clock.sleep(0.2)
        assert not operator.lets_move()
        terminal.type("  x")  # stop, with the space bar still down
        assert not operator.lets_move()


def test_a_question_is_confirmed_by_enter_and_refused_by_x() -> None:
    terminal = Terminal()
    trial = Trial(number=4, seed=1, stage=STAGES[0], color=0, places=(0, 1, 2))
    with terminal.operator as operator:
        terminal.answers = ["\n"]
        operator.prepare(trial)
        assert "Episode 4, CubeVisible" in terminal.said[-1]
        terminal.answers = ["x"]
        with pytest.raises(OperatorError, match="said no"):
            operator.ask("Go on?")


def test_what_was_typed_before_a_question_is_no_answer_to_it() -> None:
    terminal = Terminal()
    with terminal.operator as operator:
        terminal.type("\n \n")
        terminal.answers = ["x"]
        with pytest.raises(OperatorError, match="said no"):
            operator.ask("May it move?")
        terminal.type("  ")
        terminal.answers = ["x"]
        with pytest.raises(OperatorError, match="said no"):
            operator.until_held()


def test_ctrl_c_ends_a_question() -> None:
    terminal = Terminal()
    operator = KeysOperator(
        SIMULATED, terminal.clock, descriptor=terminal.descriptor, say=terminal.say, stops=lambda: True
    )
    with pytest.raises(KeyboardInterrupt), operator:
        operator.ask("May it move?")


def test_keys_need_a_terminal() -> None:
    reading, writing = os.pipe()
    operator = KeysOperator(SIMULATED, StepClock(), descriptor=reading, say=print)
    with pytest.raises(OperatorError, match="expected a terminal"), operator:
        pass
    os.close(reading)
    os.close(writing)
