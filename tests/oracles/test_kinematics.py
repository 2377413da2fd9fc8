"""The Panda's kinematics, and the translation of the experts' actions, without a simulator."""

import numpy as np
import pytest

from vla_eval.control_modes import (
    CONTROL_MODES,
    EE_DELTA_POS,
    EE_DELTA_POSE,
    EE_POSE,
    JOINT_DELTA_POS,
    JOINT_POS,
)
from vla_eval.oracles.kinematics import from_euler_xyz, inverse, rotation_vector, to_euler_xyz, tool_pose
from vla_eval.oracles.translation import command, joint_target, translated

REST_RAD = np.array([0, 0, 0, -2 * np.pi / 3, 0, 2 * np.pi / 3, np.pi / 4])


def test_at_rest_the_tool_is_where_the_simulator_has_it_and_points_down() -> None:
    pose = tool_pose(REST_RAD)
    # Measured in the official tasks: (-0.0707, 0, 0.3180) in the world, with the base at x = -0.615.
    np.testing.assert_allclose(pose[:3, 3], [-0.0707 + 0.615, 0, 0.3180], atol=1e-4)
    np.testing.assert_allclose(pose[:3, :3], np.diag([1, -1, -1]), atol=1e-9)  # quaternion (0, 1, 0, 0)


def test_the_inverse_finds_the_joints_of_a_pose_and_none_out_of_reach() -> None:
    pose = tool_pose(REST_RAD + np.array([0.1, -0.2, 0.1, 0.15, -0.1, 0.1, 0.3]))
    found = inverse(pose, REST_RAD)
    assert found is not None
    np.testing.assert_allclose(tool_pose(found), pose, atol=3e-4)
    pose[0, 3] = 2.0  # the arm is 0.855 m long
    assert inverse(pose, REST_RAD) is None


@pytest.mark.parametrize("angles", [(0.1, -0.2, 0.3), (3.0, 0.5, -2.0), (0.0, 0.0, 0.0)])
def test_euler_angles_are_those_of_rotations_about_x_then_y_then_z(angles: tuple[float, ...]) -> None:
    x, y, z = angles
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    np.testing.assert_allclose(from_euler_xyz(angles), about_x @ about_y @ about_z, atol=1e-12)
    np.testing.assert_allclose(to_euler_xyz(from_euler_xyz(angles)), angles, atol=1e-12)
    np.testing.assert_allclose(rotation_vector(about_z), [0, 0, z], atol=1e-12)


@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_every_mode_aims_at_the_same_place_as_the_expert_s_action(mode: str) -> None:
    action = np.array([0.2, -0.3, -0.1, 0, 0, 0, 0.5], dtype=np.float32)
    target = joint_target(EE_DELTA_POSE, action, REST_RAD)
    # ManiSkill: 1 is 0.1 m.
    np.testing.assert_allclose(
        tool_pose(target)[:3, 3], tool_pose(REST_RAD)[:3, 3] + [0.02, -0.03, -0.01], atol=1e-4
    )
    translated_action = command(mode, target, 0.5, REST_RAD)
    aims_m = {
        EE_DELTA_POSE: lambda row: tool_pose(REST_RAD)[:3, 3] + 0.1 * row[:3],
        EE_DELTA_POS: lambda row: tool_pose(REST_RAD)[:3, 3] + 0.1 * row[:3],
        EE_POSE: lambda row: row[:3],
        JOINT_POS: lambda row: tool_pose(row[:7])[:3, 3],
        JOINT_DELTA_POS: lambda row: tool_pose(REST_RAD + 0.1 * row[:7])[:3, 3],
    }[mode](translated_action)
    np.testing.assert_allclose(aims_m, tool_pose(target)[:3, 3], atol=1e-5)
    assert translated_action[-1] == np.float32(0.5)
    assert translated_action.shape == (len(CONTROL_MODES[mode].dims),)


def test_a_turn_survives_the_way_over_the_joints() -> None:
    action = np.array([0, 0, 0, 0.1, -0.2, 0.6, 1], dtype=np.float32)
    back = command(EE_DELTA_POSE, joint_target(EE_DELTA_POSE, action, REST_RAD), 1.0, REST_RAD)
    np.testing.assert_allclose(back, action, atol=2e-3)


def test_a_delta_mode_goes_in_the_same_direction_where_its_bounds_are_narrower() -> None:
    target = REST_RAD + np.array([0.4, 0.2, 0, 0, 0, 0, 0])
    row = command(JOINT_DELTA_POS, target, 1.0, REST_RAD)
    np.testing.assert_allclose(row, [1, 0.5, 0, 0, 0, 0, 0, 1], atol=1e-6)


def test_an_action_out_of_reach_keeps_the_joints_as_the_simulator_does() -> None:
    stretched = np.array([0, 1.5, 0, -0.1, 0, 1.6, 0.8])
    action = np.array([1, 0, 0, 0, 0, 0, 1], dtype=np.float32)
    np.testing.assert_array_equal(joint_target(EE_DELTA_POSE, action, stretched), stretched)


def test_a_chunk_is_translated_along_the_way_that_the_arm_will_have_made() -> None:
    rows = np.tile(np.array([0, 0, -1, 0, 0, 0, 1], dtype=np.float32), (5, 1))
    targets = translated(rows, JOINT_POS, REST_RAD, np.zeros(7))
    heights_m = [float(tool_pose(row[:7])[2, 3]) for row in targets]
    # Measured in the simulator: a constant action of 1 moves the tool by 16, 32, 37, 39 mm per step; each
    # target is 0.1 m below where the tool is by then.
    expected = 0.318 - 0.1 - np.cumsum([0, 0.016, 0.032, 0.037, 0.039])
    np.testing.assert_allclose(heights_m, expected, atol=0.012)
