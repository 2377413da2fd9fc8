"""The state that a LeRobot policy is given: computed here, or by the client of a server."""

import numpy as np

from vla_eval.core import Observation
from vla_eval.features import STATE_KEY, proprioception
from vla_eval.policies.lerobot.inputs import InputMap


def test_a_state_that_has_the_name_of_its_kind_is_taken_as_it_is() -> None:
    rng = np.random.default_rng(0)
    sizes = {"tcp_pose": 7, "qpos": 9, "qvel": 9}
    state = {name: rng.random(size, dtype=np.float32) for name, size in sizes.items()}
    inputs = InputMap(cameras={}, state="eef")
    computed = inputs.tensors(Observation(step=0, images={}, state=state))[STATE_KEY]
    given = inputs.tensors(Observation(step=0, images={}, state={"eef": proprioception(state)["eef"]}))

    assert computed.tolist() == given[STATE_KEY].tolist()
