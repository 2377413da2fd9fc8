"""Images, state and actions in the conventions of both ends, against values computed by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vla_eval.errors import RecipeError, SpecMismatchError
from vla_eval.policies.remote.actions import as_rows, converted
from vla_eval.policies.remote.fit import resized
from vla_eval.policies.remote.settings import ActionSettings, remote_settings, settings_digest
from vla_eval.policies.remote.state_layouts import axis_angle, state_layout
from vla_eval.specs import EnvSpec, StateSpec
from vla_eval.tasks.interface import ACTION, env_spec

ENV = env_spec()
STATE = {
    # 0.1, 0.2, 0.3 m; a quarter turn about z: cos and sin of an eighth of a turn.
    "tcp_pose": np.array([0.1, 0.2, 0.3, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], dtype=np.float32),
    "qpos": np.array([1, 2, 3, 4, 5, 6, 7, 0.01, 0.03], dtype=np.float32),
    "qvel": np.arange(9, dtype=np.float32),
}


def layout(name: str) -> np.ndarray:
    return state_layout(name, ENV, where="here").compute(STATE)


def test_the_layout_of_libero_is_position_axis_angle_and_fingers_of_opposite_signs() -> None:
    np.testing.assert_allclose(layout("libero"), [0.1, 0.2, 0.3, 0, 0, np.pi / 2, 0.01, -0.03], atol=1e-6)
    assert layout("libero").dtype == np.float32


def test_the_layouts_of_droid_are_seven_joints_and_how_closed_the_gripper_is() -> None:
    np.testing.assert_array_equal(layout("joint_positions"), [1, 2, 3, 4, 5, 6, 7])
    np.testing.assert_allclose(layout("gripper_closedness"), [0.5])  # 40 of 80 mm


def test_states_of_the_environment_may_be_joined_by_name() -> None:
    np.testing.assert_array_equal(layout("qvel+qpos"), np.concatenate([STATE["qvel"], STATE["qpos"]]))


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 180.0, 250.0])
def test_axis_angle_goes_up_to_a_whole_turn(angle_deg: float) -> None:
    half = np.radians(angle_deg) / 2
    quaternion = np.array([np.cos(half), 0, np.sin(half), 0], dtype=np.float32)
    np.testing.assert_allclose(axis_angle(quaternion), [0, np.radians(angle_deg), 0], atol=1e-5)


def test_a_layout_that_does_not_exist_or_is_another_arms_is_refused() -> None:
    with pytest.raises(SpecMismatchError, match="Did you mean 'joints'"):
        state_layout("joint", ENV, where="here")
    arm = StateSpec(name="qpos", dims=("a", "b"), unit="", frame="")
    other = EnvSpec(task="T-v0", cameras=(), states=(arm,), action=ACTION, horizon_steps=1, control_hz=20.0)
    with pytest.raises(SpecMismatchError, match="2 joints"):
        state_layout("libero", other, where="here")


# ------------------------------------------------------------------------------------------ actions

ROWS = np.array([[1.0, -0.5, 0.0, 0.2, 0.0, 0.0, 1.0]], dtype=np.float32)


@pytest.mark.parametrize(
    ("gripper", "values"),
    [
        ("open_positive", {1.0: 1.0, -1.0: -1.0}),
        ("close_positive", {1.0: -1.0, -1.0: 1.0}),
        ("open_01", {1.0: 1.0, 0.0: -1.0, 0.5: 0.0}),
        ("close_01", {1.0: -1.0, 0.0: 1.0}),
    ],
)
def test_the_gripper_opens_when_the_server_means_open(gripper: str, values: dict[float, float]) -> None:
    assert ACTION.gripper_open == 1.0
    for sent, here in values.items():
        rows = np.array([[0, 0, 0, 0, 0, 0, sent]], dtype=np.float32)
        assert converted(rows, ActionSettings(gripper=gripper), ACTION)[0, -1] == here  # type: ignore[arg-type]


def test_units_of_libero_become_those_of_maniskill() -> None:
    # 1 is 5 cm there and 10 cm here; 0.2 is 0.1 rad there; 1 is -0.1 rad here.
    settings = ActionSettings(
        gripper="close_positive", rotation="axis_angle", position_unit_m=0.05, rotation_unit_rad=0.5
    )
    np.testing.assert_allclose(
        converted(ROWS, settings, ACTION), [[0.5, -0.25, 0.0, -1.0, 0.0, 0.0, -1.0]], atol=1e-6
    )


def test_an_axis_angle_becomes_the_same_turn_as_maniskill_makes_of_the_angles() -> None:
    vector = np.array([0.3, -0.2, 0.1])
    rows = np.array([[0, 0, 0, *(vector / 0.5), 1]], dtype=np.float32)
    made = converted(rows, ActionSettings(rotation="axis_angle", rotation_unit_rad=0.5), ACTION)
    x, y, z = made[0, 3:6].astype(np.float64) * -0.1
    # ManiSkill: the matrices of the three angles, multiplied in this order.
    turn = Rotation.from_euler("x", x) * Rotation.from_euler("y", y) * Rotation.from_euler("z", z)
    np.testing.assert_allclose(turn.as_matrix(), Rotation.from_rotvec(vector).as_matrix(), atol=1e-6)


def test_without_conversions_actions_keep_their_bits() -> None:
    rows = np.random.default_rng(0).normal(size=(5, 7)).astype(np.float32)
    assert as_rows(rows).tobytes() == rows.tobytes()
    assert converted(rows, ActionSettings(), ACTION).tobytes() == rows.tobytes()


# ------------------------------------------------------------------------------------------ images


def test_padding_keeps_the_proportions_and_fills_two_sides_with_black() -> None:
    image = np.full((10, 20, 3), 200, dtype=np.uint8)
    padded = resized(image, height_px=40, width_px=40, how="pad")
    assert padded.shape == (40, 40, 3)
    assert (padded[:10] == 0).all() and (padded[30:] == 0).all()  # 20 rows of image in the middle
    assert (padded[10:30] == 200).all()


def test_plain_resizing_fills_the_whole_image() -> None:
    image = np.full((10, 20, 3), 200, dtype=np.uint8)
    assert (resized(image, height_px=40, width_px=30, how="plain") == np.full((40, 30, 3), 200)).all()


def test_an_image_of_the_right_size_stays_as_it_is() -> None:
    image = np.random.default_rng(0).integers(0, 256, (12, 12, 3)).astype(np.uint8)
    assert resized(image, height_px=12, width_px=12, how="pad") is image


# ------------------------------------------------------------------------------------------ settings


def test_the_digest_is_of_what_moves_results_and_not_of_the_place() -> None:
    def digest(**args: object) -> str:
        return settings_digest(remote_settings({"url": "ws://a:1", **args}, where="here"))

    assert digest() == digest(url="ws://b:2", timeout_seconds=1.0, connect_seconds=0.0, api_key_env="K")
    assert digest() != digest(chunk_size=3)
    assert digest() != digest(actions={"gripper": "close_positive"})


@pytest.mark.parametrize(
    "args",
    [
        {"dialect": "grpc"},
        {"chunk_size": 0},
        {"timeout_seconds": 0},
        {"cameras": {"base_camera": {"key": ""}}},
        {"cameras": {"base_camera": {"key": "i", "resize": "crop"}}},
        {"actions": {"rotation": "axis_angle"}},
        {"actions": {"gripper": "up"}},
        {"reads": "all"},
        {"state": ["joints"]},
    ],
)
def test_a_wrong_argument_is_refused(args: dict[str, object]) -> None:
    with pytest.raises(RecipeError, match="here"):
        remote_settings({"url": "ws://a:1", **args}, where="here")
