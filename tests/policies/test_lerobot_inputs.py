"""The state that a LeRobot policy is given: computed here, or by the client of a server."""

import numpy as np

from vla_eval.core import Observation
from vla_eval.features import STATE_KEY, proprioception
from vla_eval.policies.lerobot.inputs import InputMap
from vla_eval.robots.rows import SO100


def test_a_state_that_has_the_name_of_its_kind_is_taken_as_it_is() -> None:
    rng = np.random.default_rng(0)
    sizes = {"tcp_pose": 7, "qpos": 9, "qvel": 9}
    state = {name: rng.random(size, dtype=np.float32) for name, size in sizes.items()}
    inputs = InputMap(cameras={}, state="eef")
    computed = inputs.tensors(Observation(step=0, images={}, state=state))[STATE_KEY]
    given = inputs.tensors(Observation(step=0, images={}, state={"eef": proprioception(state)["eef"]}))

    assert computed.tolist() == given[STATE_KEY].tolist()


def test_the_state_of_another_robot_is_computed_from_its_own_joints() -> None:
    qpos = np.array([0.1, 0.2, 0.3, 0.4, 0.5, -0.5], dtype=np.float32)
    state = {"tcp_pose": np.array([1, 2, 3, 1, 0, 0, 0], dtype=np.float32), "qpos": qpos, "qvel": qpos * 2}
    seen = Observation(step=0, images={}, state=state)
    given = {
        kind: InputMap(cameras={}, state=kind, arm=SO100).tensors(seen)[STATE_KEY].numpy()
        for kind in ("eef", "joints")
    }
    # At -0.5 rad the jaws of its row are 4 cm apart.
    np.testing.assert_allclose(given["eef"], [1, 2, 3, 1, 0, 0, 0, 1, 0, 0.04], atol=1e-6)
    np.testing.assert_array_equal(given["joints"], np.concatenate([state["tcp_pose"], qpos, qpos * 2]))
