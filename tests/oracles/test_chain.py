"""The kinematics of arms from their chains: as in the simulator, and back."""

from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from vla_eval.config.environment import EnvSettings
from vla_eval.control_modes import DELTA_M, JOINT_DELTA_POS, JOINT_POS
from vla_eval.envs.factory import make_env
from vla_eval.oracles.chain import hand_pose, nearest_joints
from vla_eval.oracles.joint_motion import joint_rows
from vla_eval.robots.arm import Arm
from vla_eval.robots.rows import ROWS

CHAINS = [arm for arm in ROWS if arm.chain is not None]
every_chain = pytest.mark.parametrize("arm", CHAINS, ids=lambda arm: arm.name)


def drawn_joints(arm: Arm, n: int) -> Any:
    assert arm.chain is not None
    return np.random.default_rng(0).uniform(arm.chain.low_rad, arm.chain.high_rad, (n, len(arm.arm_joints)))


@every_chain
def test_the_hand_is_where_the_simulator_has_it(arm: Arm) -> None:
    env: Any = make_env(EnvSettings(task="RememberColor3-v0", kwargs={"robot": arm.name}))
    env.reset({0: 1}, render=False)
    simulated = env._envs[0]
    for joints in drawn_joints(arm, 20):
        qpos = np.array([*joints, arm.rest_qpos[-1]], dtype=np.float32)
        simulated.agent.robot.set_qpos(qpos)
        pose = hand_pose(arm, joints).tool
        position, (w, x, y, z) = np.split(simulated.tcp_pose()[0], [3])
        np.testing.assert_allclose(pose[:3, 3], position, atol=1e-4)
        np.testing.assert_allclose(
            pose[:3, 2], [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], atol=1e-4
        )
    env.close()


@every_chain
def test_limits_and_gaps_are_those_of_the_robots_description(arm: Arm) -> None:
    env: Any = make_env(EnvSettings(task="RememberColor3-v0", kwargs={"robot": arm.name}))
    limits = {
        joint.attrib["name"]: joint.find("limit")
        for joint in ElementTree.parse(env._envs[0].agent.urdf_path).iter("joint")
        if joint.attrib["type"] == "revolute"
    }
    assert arm.chain is not None
    for name, low, high in zip(arm.joints, arm.chain.low_rad, arm.chain.high_rad, strict=False):
        limit = limits[name]
        assert limit is not None
        assert (float(limit.attrib["lower"]), float(limit.attrib["upper"])) == (low, high)
    jaw = limits[arm.joints[-1]]
    assert jaw is not None
    assert {arm.gripper.closed, arm.gripper.opened} == {float(jaw.attrib[end]) for end in ("lower", "upper")}
    env.close()


@every_chain
def test_the_joints_of_a_place_are_found_and_the_hand_is_turned_as_asked(arm: Arm) -> None:
    rest = np.array(arm.rest_qpos)[list(arm.arm_joints)]
    home = hand_pose(arm, rest).tool[:3, 3]
    rng = np.random.default_rng(1)
    for _ in range(20):
        place = home + rng.uniform((-0.02, -0.1, -0.07), (0.08, 0.1, -0.03))
        yaw_rad = float(rng.uniform(-0.5, 0.5))
        tool = hand_pose(arm, nearest_joints(arm, place, yaw_rad, rest)).tool
        np.testing.assert_allclose(tool[:3, 3], place, atol=1e-3)
        assert np.arctan2(tool[1, 0], tool[0, 0]) == pytest.approx(yaw_rad, abs=0.05)


@every_chain
def test_a_place_out_of_reach_brings_the_hand_as_near_as_it_goes_within_the_limits(arm: Arm) -> None:
    assert arm.chain is not None
    rest = np.array(arm.rest_qpos)[list(arm.arm_joints)]
    far = np.array([1.0, 0.2, 0.1])
    joints = nearest_joints(arm, far, 0.0, rest)
    assert np.all((joints >= arm.chain.low_rad) & (joints <= arm.chain.high_rad))
    hand = hand_pose(arm, joints)
    # The arm is stretched: from its first axis, no drawn joints bring the hand farther in that direction.
    way = (far - hand.points_m[0])[:2] / np.linalg.norm((far - hand.points_m[0])[:2])
    reached = [
        (hand_pose(arm, one).tool[:3, 3] - hand.points_m[0])[:2] @ way for one in drawn_joints(arm, 300)
    ]
    assert (hand.tool[:3, 3] - hand.points_m[0])[:2] @ way > max(reached) - 0.03


@every_chain
@pytest.mark.parametrize("mode", [JOINT_POS, JOINT_DELTA_POS])
def test_a_row_of_the_experts_moves_the_joints_to_where_it_points(arm: Arm, mode: str) -> None:
    qpos = np.array(arm.rest_qpos)
    joints = qpos[list(arm.arm_joints)]
    here = hand_pose(arm, joints).tool[:3, 3]
    row = np.array([[0.1, -0.2, -0.2, 0, 0, 0, 1]], dtype=np.float32)
    (action,) = joint_rows(row, arm, mode, qpos, np.zeros(len(qpos)))
    assert action.dtype == np.float32 and len(action) == len(arm.actions[mode].dims)
    aimed = action[:-1] if mode == JOINT_POS else joints + 0.1 * action[:-1]  # 0.1 rad is 1 in a delta mode
    way = hand_pose(arm, aimed.astype(float)).tool[:3, 3] - here
    wanted = DELTA_M * row[0, :3]
    assert way @ wanted > 0.9 * np.linalg.norm(way) * np.linalg.norm(wanted)
    if mode == JOINT_POS:
        np.testing.assert_allclose(way, wanted, atol=1e-3)


@every_chain
def test_a_row_without_motion_leaves_the_joints_where_they_are(arm: Arm) -> None:
    qpos = np.array(arm.rest_qpos)
    still = np.array([[0, 0, 0, 0, 0, 0, 1]], dtype=np.float32)
    (action,) = joint_rows(still, arm, JOINT_POS, qpos, np.zeros(len(qpos)))
    np.testing.assert_allclose(action[:-1], qpos[list(arm.arm_joints)], atol=1e-6)
