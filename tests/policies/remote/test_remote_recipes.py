"""The shipped recipes of remote policies, each against a server of a few lines in the words of its kind."""

import time
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.sync.server import ServerConnection

from tests.wire.small_servers import SmallServer, serving, some_actions
from vla_eval.chunking import ChunkingSettings
from vla_eval.config.environment import EnvSettings
from vla_eval.config.files import list_recipes, load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.core import EpisodeStart
from vla_eval.envs.fake import FakeEnv
from vla_eval.errors import InvalidActionError, RemoteReplyError, RemoteTimeoutError, VlaEvalError
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.remote.policy import RemotePolicy, make_remote
from vla_eval.rollout import RolloutSettings, rollout

SHORT = {"horizon_steps": 8, "delay_steps": 1}
TASK = "RememberColor3-v0"
CAMERAS = ("base_camera", "hand_camera")


def run(name: str, handler: Callable[[ServerConnection], None], *, n_slots: int = 1, **changes: Any) -> Any:
    """Run episodes of eight steps with a shipped recipe; returns their records."""
    recipe = load_recipe("policies", name, PolicyRecipe).value
    chunking = ChunkingSettings().at(recipe.default_n_action_steps)
    env = FakeEnv(EnvSettings(task=TASK, kwargs=SHORT, cameras=CAMERAS, n_slots=n_slots))
    context = PolicyContext(name=name, env=env.spec, chunking=chunking, n_candidates=3, n_slots=n_slots)
    starts = [
        EpisodeStart(slot=slot, task=TASK, seed=slot, run=0, instruction="touch it", horizon_steps=8)
        for slot in range(n_slots)
    ]
    with serving(handler) as url:
        policy: RemotePolicy = make_remote(context, **{**recipe.args, "url": url, **changes})
        try:
            return rollout(env, policy, starts, RolloutSettings(chunking=chunking))
        finally:
            policy.close()


def test_every_shipped_recipe_of_a_remote_policy_is_tested_here() -> None:
    recipes = {name: load_recipe("policies", name, PolicyRecipe).value for name in list_recipes("policies")}
    assert {name for name, recipe in recipes.items() if recipe.adapter == "remote"} == {
        "remote_ours",
        *OPENPI,
        "remote_vla_eval",
    }


def test_ours_takes_everything_from_the_server() -> None:
    server = SmallServer()
    (record,) = run("remote_ours", server)
    assert record.n_inferences == 8
    assert server.requests[0]["endpoint"] == "reset"


OPENPI = {
    "remote_openpi": (10, {"observation/image": 3, "observation/wrist_image": 3, "observation/state": 10}),
    "remote_openpi_libero": (
        10,
        {"observation/image": 3, "observation/wrist_image": 3, "observation/state": 8},
    ),
    "remote_openpi_droid": (
        15,
        {
            **{"observation/exterior_image_1_left": 3, "observation/wrist_image_left": 3},
            **{"observation/joint_position": 7, "observation/gripper_position": 1},
        },
    ),
}


@pytest.mark.parametrize("name", OPENPI)
def test_an_openpi_server_gets_the_keys_of_its_policies(name: str) -> None:
    chunk_size, keys = OPENPI[name]
    server = SmallServer()
    server.metadata = {}
    server.answer = lambda request: {
        "actions": some_actions(0, 0, chunk_size),
        "server_timing": {"infer_ms": 1.0},
    }
    run(name, server)
    for request in server.requests:
        assert {key: value.shape[-1] for key, value in request.items() if key != "prompt"} == keys
        assert {v.shape for k, v in request.items() if "image" in k} == {(224, 224, 3)}
        assert request["prompt"] == "touch it"


def test_eight_joint_velocities_of_droid_are_refused() -> None:
    server = SmallServer()
    server.metadata = {}
    server.answer = lambda request: {"actions": np.zeros((15, 8), dtype=np.float32)}
    with pytest.raises(InvalidActionError, match=r"found shape \(15, 8\)"):
        run("remote_openpi_droid", server)


# ------------------------------------------------------------------------------------------ vla-eval


class VlaEvalServer:
    """Speaks as vla-eval 0.8.0 does, without this package's codec: text as markers, an envelope."""

    def __init__(self) -> None:
        self.messages: list[dict[str, Any]] = []
        self.reply: Callable[[dict[str, Any]], tuple[str, dict[str, Any]]] = self.usual_reply
        self.version = 1
        self.seq_offset = 0

    def usual_reply(self, message: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        actions = some_actions(0, len(self.messages), 1)[0]
        packed = {"data": actions.tobytes(), "dtype": actions.dtype.str, "shape": list(actions.shape)}
        return "action", {"actions": {"__ndarray__": True, **packed}}

    def __call__(self, connection: ServerConnection) -> None:
        def send(kind: str, payload: dict[str, Any], seq: int) -> None:
            message = {"type": kind, "payload": payload, "seq": seq, "timestamp": time.time()}
            connection.send(msgpack.packb(message))

        for frame in connection:
            message = msgpack.unpackb(frame)  # raises for keys that are no text
            self.messages.append(message)
            assert set(message) == {"type", "payload", "seq", "timestamp"}
            if message["type"] == "hello":
                says = {"harness_version": "0.8.0", "protocol_version": self.version, "model_server": "Small"}
                send("hello", {**says, "capabilities": {}}, message["seq"])
            elif message["type"] == "observation":
                send(*self.reply(message), message["seq"] + self.seq_offset)


def test_a_server_of_vla_eval_gets_greeting_episode_and_one_frame_per_step() -> None:
    server = VlaEvalServer()
    (record,) = run("remote_vla_eval", server)
    kinds = [message["type"] for message in server.messages]
    assert kinds == ["hello", "episode_start", *["observation"] * 8]
    assert record.n_inferences == 8
    observation = server.messages[2]["payload"]
    assert list(observation["images"]) == ["base_camera", "hand_camera"]
    image = observation["images"]["base_camera"]
    assert image["__ndarray__"] is True
    assert np.frombuffer(image["data"], image["dtype"]).size == np.prod(image["shape"])
    assert observation["task_description"] == "touch it"
    assert [message["seq"] for message in server.messages] == list(range(1, 11))


def test_each_slot_has_a_session_of_its_own_at_a_server_of_vla_eval() -> None:
    server = VlaEvalServer()
    run("remote_vla_eval", server, n_slots=2)
    assert [message["type"] for message in server.messages].count("hello") == 2


def refusal(server: VlaEvalServer, **changes: Any) -> VlaEvalError:
    with pytest.raises(VlaEvalError) as error:
        run("remote_vla_eval", server, **changes)
    return error.value


def test_an_error_of_a_server_of_vla_eval_ends_the_episode() -> None:
    server = VlaEvalServer()
    server.reply = lambda message: ("error", {"error": "observation_failed: KeyError: 'states'"})
    error = refusal(server)
    assert isinstance(error, RemoteReplyError)
    assert "KeyError: 'states'" in str(error)


@pytest.mark.parametrize(
    ("reply", "problem"),
    [
        (("hello", {}), "expected 'action'"),
        (("action", {}), "expected 'actions'"),
    ],
)
def test_another_message_than_the_actions_is_refused(reply: Any, problem: str) -> None:
    server = VlaEvalServer()
    server.reply = lambda message: reply
    assert problem in str(refusal(server))


def test_an_answer_for_another_message_is_refused() -> None:
    server = VlaEvalServer()
    server.seq_offset = -1
    assert "expected 'action' for message 3, found 'action' for 2" in str(refusal(server))


def test_another_version_of_the_protocol_is_refused() -> None:
    server = VlaEvalServer()
    server.version = 2
    assert "expected version 1 of the protocol of vla-eval, found 2" in str(refusal(server))


def test_a_server_of_vla_eval_that_is_silent_is_not_waited_for_longer_than_asked() -> None:
    def silent(connection: ServerConnection) -> None:
        for _ in connection:
            pass

    with pytest.raises(RemoteTimeoutError):
        run("remote_vla_eval", silent, timeout_seconds=0.2)
