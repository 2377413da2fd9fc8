"""A memory over a socket: the same bits as in process, and hostile ones refused."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import connect

from tests.checkpoints import small_checkpoints
from tests.checkpoints.small_checkpoints import context_for, save, start, with_features
from tests.policies.test_memory_arrays import at, config_of, two_slots
from tests.serving.served_policies import CountingPolicy, Running, frame, serving
from tests.wire.small_servers import OURS, SmallServer
from tests.wire.small_servers import serving as small_serving
from vla_eval.envs.factory import make_env
from vla_eval.errors import RemoteReplyError
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.policies.remote.policy import RemotePolicy, make_remote
from vla_eval.serving.host import HostOptions, host_policy
from vla_eval.serving.server import ServerOptions
from vla_eval.specs import EnvSpec
from vla_eval.testing import check_policy
from vla_eval.wire.codec import packb, unpackb

backbone, env = small_checkpoints.backbone, small_checkpoints.env


@pytest.fixture(scope="module")
def gru(backbone: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(with_features(config_of("gru")), tmp_path_factory.mktemp("gru") / "model")


@contextmanager
def served(checkpoint: Path) -> Iterator[Running]:
    running = Running(host_policy(HostOptions(policy=str(checkpoint), max_batch=2)), ServerOptions(port=0))
    try:
        yield running
    finally:
        running.stop()
        running.wait()


def remote(server: Any, env: EnvSpec) -> RemotePolicy:
    return make_remote(two_slots(env), url=server.url)


@pytest.mark.slow
def test_a_served_policy_keeps_the_contract_of_a_memory(gru: Path, env: EnvSpec) -> None:
    with served(gru) as server:
        made = [remote(server, env) for _ in range(3)]
        policies = iter(made)
        met = check_policy(lambda: next(policies), env)
        for policy in made:
            policy.close()
    assert sum("memory is read, lost, and put back" in claim for claim in met) == 2


def test_a_memory_goes_from_a_process_to_a_server_and_back(gru: Path, env: EnvSpec) -> None:
    here = make_lerobot(two_slots(env), checkpoint=str(gru))
    with served(gru) as server:
        there = remote(server, env)
        here.reset([start(0, seed=1)])
        there.reset([start(0, seed=1)])
        here.act(at(0))
        there.set_memory(0, here.get_memory(0))
        for name, part in there.get_memory(0).items():
            assert np.array_equal(part, here.get_memory(0)[name])
        assert np.array_equal(there.act(at(1)).actions, here.act(at(1)).actions)
        there.close()


HOSTILE: dict[str, Any] = {
    "nothing": None,
    "a list": [np.zeros(3, np.float32)],
    "text": {"policy/0": "memory"},
    "an array of text": {"policy/0": np.array(["a"])},
    "another name": {"policy/99": np.zeros(3, np.float32)},
    "no arrays": {},
    "another shape": {"policy/0": np.zeros((3, 3, 3), np.float32)},
    "double precision": {"policy/0": np.zeros(16)},
    "other bytes": {"policy/0": np.zeros(16, ">f4")},
    "too many arrays": {f"policy/{i}": np.zeros(1, np.float32) for i in range(2000)},
    "too many bytes": {"policy/0": np.zeros(9 * 2**20, np.float32)},
    "frames": {"frames/observation.state": np.zeros((1, 10), np.float32)},
}


@pytest.mark.parametrize("memory", HOSTILE.values(), ids=HOSTILE.keys())
def test_a_hostile_memory_is_refused_and_others_go_on(gru: Path, env: EnvSpec, memory: Any) -> None:
    with served(gru) as server:
        other = remote(server, env)
        other.reset([start(0, seed=1)])
        kept = other.get_memory(0)
        with connect(server.url, compression=None, max_size=None) as socket:
            socket.recv()
            socket.send(packb({"endpoint": "reset", "session_id": "a", "prompt": "touch it"}))
            assert unpackb(socket.recv())["status"] == "reset"
            socket.send(packb({"endpoint": "memory/set", "session_id": "a", "memory": memory}))
            said = socket.recv()
        assert isinstance(said, str) and "expected" in said and "found" in said and "Traceback" not in said
        for name, part in other.get_memory(0).items():
            assert np.array_equal(part, kept[name])
        other.close()


@pytest.mark.parametrize("endpoint", ["memory/get", "memory/set"])
def test_a_policy_without_a_memory_and_a_session_without_an_episode_are_refused(endpoint: str) -> None:
    with serving(CountingPolicy()) as server:
        for begins, why in ((False, "without an episode"), (True, "has no memory")):
            with connect(server.url, compression=None) as socket:
                assert "memory" not in unpackb(socket.recv())["supports"]
                if begins:
                    socket.send(packb({**frame(), "endpoint": "reset"}))
                    socket.recv()
                socket.send(packb({"endpoint": endpoint, "memory": {}}))
                said = socket.recv()
                assert isinstance(said, str) and why in said


@contextmanager
def answering(reply: dict[str, Any]) -> Iterator[str]:
    """Serve someone who announces a memory and, asked for it, answers this."""
    server = SmallServer(supports=[*OURS["supports"], "memory"])

    def answer(request: dict[str, Any]) -> Any:
        if request["endpoint"] != "memory/get":
            return server.usual_answer(request)
        return {**reply, **{key: request[key] for key in ("session_id", "step")}}

    server.answer = answer
    with small_serving(server) as url:
        yield url


@pytest.mark.parametrize("status", [None, "reset", "memory/set", 3, np.zeros(2), ["memory/get"]])
def test_a_server_that_answers_something_else_is_refused(status: Any) -> None:
    with answering({"status": status, "memory": {}}) as url:
        policy = make_remote(context_for(make_env(small_checkpoints.FAKE).spec), url=url)
        policy.reset([start(0, seed=1)])
        with pytest.raises(RemoteReplyError, match="expected the status 'memory/get'"):
            policy.get_memory(0)
        policy.close()


@pytest.mark.parametrize("memory", [None, 3, {"a": "b"}, {"a": [1.0]}, {"a": np.array(["x"])}])
def test_a_server_that_sends_no_memory_is_refused(memory: Any) -> None:
    with answering({"status": "memory/get", "memory": memory}) as url:
        policy = make_remote(context_for(make_env(small_checkpoints.FAKE).spec), url=url)
        policy.reset([start(0, seed=1)])
        with pytest.raises(RemoteReplyError, match="memory"):
            policy.get_memory(0)
        policy.close()
