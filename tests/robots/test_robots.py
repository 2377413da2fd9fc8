"""The rows of robots agree with themselves, and the arguments of a task name one robot or none."""

from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest

from vla_eval.cli.main import main
from vla_eval.config.environment import EnvSettings
from vla_eval.control_modes import CONTROL_MODES, EE_DELTA_POSE, JOINT_DELTA_POS, JOINT_POS
from vla_eval.envs.factory import describe_env
from vla_eval.errors import PluginError, TaskArgumentError, UnknownNameError
from vla_eval.robots import find
from vla_eval.robots.arm import Arm
from vla_eval.robots.find import action_of, control_mode_of, robot_of, robot_with_uid, robots
from vla_eval.robots.rows import FETCH, KOCH, PANDA, ROWS, SO100
from vla_eval.tasks.catalog import FAMILIES
from vla_eval.tasks.families import FAMILY_TABLE

TASK = "RememberColor3-v0"
ROW_OF = {family.id: family.row for family in FAMILY_TABLE}
every_robot = pytest.mark.parametrize("arm", ROWS, ids=lambda arm: arm.name)


@every_robot
def test_a_row_agrees_with_itself(arm: Arm) -> None:
    assert len(arm.rest_qpos) == len(arm.joints) == len(set(arm.joints))
    fingers = {joint % len(arm.joints) for joint in arm.gripper.joints}
    assert not fingers & set(arm.arm_joints)
    assert arm.not_solved.keys() <= FAMILIES.keys()
    for mode, action in arm.actions.items():
        assert action.control_mode == mode and action.dims[-1] == "gripper"
        if mode in (JOINT_POS, JOINT_DELTA_POS):
            assert len(action.dims) == len(arm.arm_joints) + 1
    if arm.chain is not None:
        assert len(arm.chain.hinges) == len(arm.arm_joints)
        rest = np.array(arm.rest_qpos)[list(arm.arm_joints)]
        assert np.all((arm.chain.low_rad < rest) & (rest < arm.chain.high_rad))


def test_no_two_robots_share_a_name() -> None:
    names = [name for arm in ROWS for name in (arm.name, *arm.uids) if name != PANDA.name]
    assert len(names) == len(set(names))


@every_robot
def test_the_fingers_open_as_far_as_they_are_told(arm: Arm) -> None:
    ends = (arm.gripper.closed, arm.gripper.opened)
    qpos = np.array([arm.rest_qpos, arm.rest_qpos])
    for joint in arm.gripper.joints:
        qpos[:, joint] = ends
    narrow, wide = (float(width) for width in arm.gripper.width_m(qpos))
    for width_m in np.linspace(narrow, wide, 23):
        share = (arm.gripper.command(float(width_m)) + 1) / 2
        for joint in arm.gripper.joints:
            qpos[0, joint] = ends[0] + share * (ends[1] - ends[0])
        assert arm.gripper.width_m(qpos)[0] == pytest.approx(width_m, abs=1e-9)
    assert (arm.gripper.command(narrow - 0.01), arm.gripper.command(wide + 0.01)) == (-1.0, 1.0)


@pytest.mark.parametrize(
    ("given", "arm", "mode"),
    [
        ({}, PANDA, EE_DELTA_POSE),
        ({"robot": "panda_wristcam"}, PANDA, EE_DELTA_POSE),
        ({"robot": "panda_wristcam", "control_mode": JOINT_POS}, PANDA, JOINT_POS),
        ({"robot": "fetch"}, FETCH, EE_DELTA_POSE),
        ({"robot_uids": "fetch_at_table"}, FETCH, EE_DELTA_POSE),
        ({"robot": "so100"}, SO100, JOINT_POS),
        ({"robot": "koch", "control_mode": JOINT_DELTA_POS}, KOCH, JOINT_DELTA_POS),
    ],
)
def test_the_arguments_name_the_robot_and_its_first_mode_is_the_default(
    given: dict[str, Any], arm: Arm, mode: str
) -> None:
    assert robot_of(given) is arm
    assert control_mode_of(given) == mode
    assert action_of(given) is arm.actions[mode]


@pytest.mark.parametrize("uid", PANDA.uids)
def test_every_variant_of_a_robot_is_that_robot(uid: str) -> None:
    assert robot_with_uid(uid) is PANDA


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"robot": "so10"}, UnknownNameError, r"env\.robot: there is no robot 'so10'.*'so100'"),
        ({"robot": "fetch_at_table"}, UnknownNameError, r"env\.robot: .*Did you mean 'fetch'"),
        ({"robot": 5}, UnknownNameError, "there is no robot '5'"),
        (
            {"robot": "so100", "robot_uids": "fetch_at_table"},
            TaskArgumentError,
            "both name the robot. Leave robot_uids out",
        ),
        (
            {"robot": "so100", "control_mode": EE_DELTA_POSE},
            TaskArgumentError,
            "robot='so100': this arm takes pd_joint_pos, pd_joint_delta_pos",
        ),
        ({"robot": "so100", "control_mode": "pd_joint_po"}, UnknownNameError, "Did you mean 'pd_joint_pos'"),
        ({"robot": "so100", "move_in_delay": True}, TaskArgumentError, "move_in_delay"),
    ],
)
def test_what_names_no_robot_or_two_is_refused(
    given: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        describe_env(EnvSettings(task=TASK, kwargs=given))


@every_robot
def test_a_task_that_a_robot_does_not_solve_is_refused_with_the_reason_and_those_that_do(arm: Arm) -> None:
    for family, why in arm.not_solved.items():
        with pytest.raises(TaskArgumentError) as told:
            describe_env(EnvSettings(task=ROW_OF[family], kwargs={"robot": arm.name}))
        assert why in str(told.value)
        assert PANDA.name in str(told.value).partition("Robots that do:")[2]


class TestInstalledRobots:
    """Robots of other packages: found by an entry point, and refused with the package's name."""

    @pytest.fixture
    def installed(self, monkeypatch: pytest.MonkeyPatch) -> Any:
        def install(loaded: object) -> None:
            class Point(EntryPoint):
                def load(self) -> Any:
                    if isinstance(loaded, Exception):
                        raise loaded
                    return loaded

            point = Point(name="mine", value="my_package:ROBOT", group=find.ROBOT_GROUP)
            monkeypatch.setattr(find, "entry_points", lambda *, group: [point] * (group == find.ROBOT_GROUP))
            robots.cache_clear()

        yield install
        robots.cache_clear()

    def test_one_is_named_like_those_that_ship(self, installed: Any) -> None:
        mine = Arm(
            name="mine",
            agent="my_package:Agent",
            uids=("my_agent",),
            description="a robot of my own",
            joints=PANDA.joints,
            arm_joints=PANDA.arm_joints,
            gripper=PANDA.gripper,
            rest_qpos=PANDA.rest_qpos,
            base_m=PANDA.base_m,
            actions={EE_DELTA_POSE: CONTROL_MODES[EE_DELTA_POSE]},
        )
        installed(mine)
        assert robot_of({"robot": "mine"}) is robot_with_uid("my_agent") is mine
        assert describe_env(EnvSettings(task=TASK, kwargs={"robot": "mine"})).robot == "mine"

    @pytest.mark.parametrize(
        ("loaded", "problem"),
        [
            (ImportError("no torch"), "ImportError: no torch"),
            ("my_agent", "found 'my_agent', expected an `Arm`"),
            (SO100, "its name 'so100' or one of its uids"),
        ],
    )
    def test_one_that_cannot_be_used_says_whose_it_is(
        self, loaded: object, problem: str, installed: Any
    ) -> None:
        installed(loaded)
        with pytest.raises(PluginError, match=f"adds a robot by my_package:ROBOT .*{problem}"):
            robot_of({"robot": "so100"})

    def test_the_list_names_those_that_ship_and_whose_cannot_be_used(
        self, installed: Any, capsys: pytest.CaptureFixture[str]
    ) -> None:
        installed(ImportError("no torch"))
        assert main(["list", "robots"]) == 0
        printed = capsys.readouterr().out
        assert [line.split()[0] for line in printed.splitlines()[: len(ROWS)]] == [a.name for a in ROWS]
        assert "cannot be read:" in printed and "no torch" in printed
