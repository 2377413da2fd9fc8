"""`mikasa_vla_client.serve`: its sessions, what it says of itself, and what it refuses."""

import contextlib
import hashlib
import http.client
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from tests.mikasa_vla_client.serving import (
    HOLDABLE_SPEC,
    MEMORY_SPEC,
    PLAIN_SPEC,
    HeldSums,
    Sums,
    client,
    served,
)
from vla_eval import features
from vla_eval.wire.codec import packb, unpackb
from vla_eval.wire.metadata import ServerMetadata

EEF = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0, 0], dtype=np.float32)  # no rotation
FRAME = {
    "observation/image": np.full((128, 128, 3), 7, dtype=np.uint8),
    "observation/state": np.array([0, 0, 0, 1, *[0] * 21], dtype=np.float32),
    "prompt": "pick up the red cube",
}


class Client:
    """One connection."""

    def __init__(self, url: str) -> None:
        self._opened = contextlib.ExitStack()
        self._socket = self._opened.enter_context(connect(url, compression=None))
        self.metadata: Any = unpackb(self._socket.recv(timeout=10))

    def send(self, **message: Any) -> None:
        self._socket.send(packb(message))

    def receive(self) -> Any:
        reply = self._socket.recv(timeout=10)
        return reply if isinstance(reply, str) else unpackb(reply)

    def ask(self, **message: Any) -> Any:
        self.send(**message)
        return self.receive()

    def close(self) -> None:
        self._opened.close()


class TestDescription:
    def test_the_evaluation_reads_what_the_server_says_of_itself(self, tmp_path: Path) -> None:
        weights = tmp_path / "weights.bin"
        weights.write_bytes(b"weights")
        spec = client.PolicySpec(
            name="p", chunk_size=3, cameras=["hand_camera"], state="eef", weights_file=str(weights)
        )
        said = ServerMetadata.from_wire(spec.metadata(), where="ws://x")
        assert said.is_ours and said.name == "p" and said.chunk_size == 3 and said.batch_max == 1
        assert said.weights_sha256 == hashlib.sha256(b"weights").hexdigest()
        assert said.cameras is not None
        assert said.cameras["hand_camera"] == ("observation/wrist_image", 128, 128)
        assert said.state_layouts == {"eef": features.STATE_NAMES["eef"]}
        assert said.action_dims == features.ACTION_NAMES

    def test_state_layouts_are_those_of_the_evaluation(self) -> None:
        from mikasa_vla_client.spec import STATE_LAYOUTS

        assert STATE_LAYOUTS == features.STATE_NAMES

    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"name": ""}, "name is '', expected a text that is not empty"),
            ({"chunk_size": 0}, "chunk_size is 0, expected a number from 1"),
            ({"chunk_size": True}, "chunk_size is True"),
            ({"n_action_steps": 2}, "n_action_steps is 2, expected a number from 1 to chunk_size"),
            ({"cameras": "base_camera"}, "cameras is 'base_camera', expected a tuple of names"),
            ({"cameras": ("top",)}, r"cameras is \('top',\), expected names out of base_camera, hand_camera"),
            ({"state": "joint"}, "state is 'joint', expected 'joints' or 'eef' or None"),
            ({"image_size_px": 128}, r"image_size_px is 128, expected \(height, width\)"),
            ({"action_dims": ()}, "action_dims is .*, expected at least one name"),
            ({"control_mode": ""}, "control_mode"),
            ({"control_hz": float("inf")}, "control_hz is inf, expected a number above 0"),
            ({"needs_every_frame": 1}, "needs_every_frame is 1, expected True or False"),
            ({"weights_file": "no/such"}, "weights_file is 'no/such', expected a file that exists"),
        ],
    )
    def test_a_wrong_value_is_refused_with_what_was_expected(
        self, fields: dict[str, Any], message: str
    ) -> None:
        with pytest.raises(client.SpecError, match=message):
            client.PolicySpec(**{"name": "p", "chunk_size": 1, **fields})

    def test_a_policy_without_the_methods_that_its_spec_asks_for_is_refused(self) -> None:
        with pytest.raises(client.SpecError, match="no method observe"):
            client.PolicyServer(lambda observation: None, MEMORY_SPEC, port=0).close()


class TestEpisodes:
    def test_sessions_of_one_connection_have_their_own_memory_until_they_are_reset(self) -> None:
        with served(Sums()) as url:
            one = Client(url)
            start = {"endpoint": "reset", "prompt": "p", "seed": 3}
            assert one.ask(**start, session_id="a")["status"] == "reset"
            first = one.ask(**FRAME, session_id="a", step=0)
            assert (first["session_id"], first["step"]) == ("a", 0)
            assert set(first["server_timing"]) == {"infer_ms", "queue_ms", "prev_total_ms"}
            one.ask(**start, session_id="b")
            second = one.ask(**FRAME, session_id="a", step=4)
            other = one.ask(**FRAME, session_id="b", step=0)
            one.ask(**start, session_id="a")
            again = one.ask(**FRAME, session_id="a", step=0)
            one.close()
        # The start is drawn by the seed, each frame adds its brightness, 7.
        drawn = np.random.default_rng(3).normal()
        for reply, total in ((first, 7), (second, 14), (other, 7), (again, 7)):
            np.testing.assert_array_equal(
                reply["actions"], np.full((4, 7), np.sin(drawn + total), np.float32)
            )

    def test_an_observed_frame_has_no_reply_and_is_remembered(self) -> None:
        with served(Sums()) as url:
            one = Client(url)
            one.ask(endpoint="reset", prompt="p", seed=0)
            one.send(**FRAME, endpoint="observe")
            reply = one.ask(**FRAME)
            one.close()
        drawn = np.random.default_rng(0).normal()
        np.testing.assert_allclose(reply["actions"], np.full((4, 7), np.sin(drawn + 14)), rtol=1e-6)

    def test_openpis_message_without_a_session_begins_an_episode_with_its_prompt(self) -> None:
        seen: list[Any] = []

        def policy(observation: Any) -> Any:
            seen.append(observation)
            return np.zeros((2, 7))

        state = {b"__ndarray__": True, b"data": EEF.tobytes(), b"dtype": "<f4", b"shape": [10]}
        with served(policy, PLAIN_SPEC) as url, connect(url) as socket:
            socket.recv(timeout=10)
            socket.send(msgpack.packb({"observation/state": state, "prompt": "go"}))
            reply = socket.recv(timeout=10)
        assert isinstance(reply, bytes)
        assert unpackb(reply)["actions"].shape == (2, 7)
        assert set(seen[0]) == {"observation/state", "prompt"} and seen[0]["prompt"] == "go"

    def test_sessions_end_with_their_connection(self) -> None:
        with served(lambda observation: np.zeros((2, 7)), PLAIN_SPEC) as url:
            one, two = Client(url), Client(url)
            for session_id in ("a", "b"):
                one.ask(endpoint="reset", prompt="p", session_id=session_id)
            two.close()
            three = Client(url)
            one.close()
            three.close()
        assert (two.metadata["n_sessions"], three.metadata["n_sessions"]) == (0, 2)


class TestRefusals:
    @pytest.mark.parametrize(
        ("message", "expected"),
        [
            ({"prompt": "p"}, "the observation has no 'observation/state' .it has: prompt."),
            (
                {"prompt": "p", "observation/state": EEF[:9]},
                r"expected an array of 10 numbers, float32 or float64; found float32 of shape \(9,\)",
            ),
            ({"observation/state": EEF}, "'prompt': an episode begins with an instruction, found None"),
            ({"prompt": "p", "endpoint": "jump"}, "no endpoint 'jump' .known: infer, reset, observe"),
            ({"prompt": "p", "endpoint": "reset", "seed": "1"}, "seed: expected int, found '1'"),
            ({"prompt": "p", "session_id": 1}, "session_id: expected a text, found 1"),
        ],
    )
    def test_a_wrong_message_is_answered_with_a_text(self, message: dict[str, Any], expected: str) -> None:
        with served(lambda observation: np.zeros((2, 7)), PLAIN_SPEC) as url:
            one = Client(url)
            with pytest.raises(AssertionError, match=expected):
                raise AssertionError(one.ask(**message))
            one.close()

    @pytest.mark.parametrize(
        ("policy", "expected"),
        [
            (lambda observation: np.zeros((3, 7)), r"returned actions of shape \(3, 7\), expected \(2, 7\)"),
            (lambda observation: np.full((2, 7), np.nan), "returned actions that are not finite"),
            (lambda observation: observation["top"], "policy 'plain' failed: KeyError: 'top'"),
        ],
    )
    def test_a_policy_that_fails_is_an_error_of_the_client_without_a_traceback(
        self, policy: Any, expected: str
    ) -> None:
        with served(policy, PLAIN_SPEC) as url:
            one = Client(url)
            text = one.ask(**{"prompt": "p", "observation/state": EEF})
            one.close()
        assert isinstance(text, str) and "Traceback" not in text
        with pytest.raises(AssertionError, match=expected):
            raise AssertionError(text)

    def test_a_client_without_the_key_is_refused_and_healthz_needs_none(self) -> None:
        with served(lambda observation: np.zeros((2, 7)), PLAIN_SPEC, api_key="secret") as url:
            with pytest.raises(InvalidStatus, match="401"):
                connect(url)
            with connect(url, additional_headers={"Authorization": "Api-Key secret"}) as socket:
                assert unpackb(socket.recv(timeout=10))["name"] == "plain"
            health = http.client.HTTPConnection(url.removeprefix("ws://"), timeout=10)
            health.request("GET", "/healthz")
            answer = health.getresponse()
            assert (answer.status, answer.read()) == (200, b"OK\n")
            health.close()


class TestMemory:
    def test_it_goes_from_one_session_to_another(self) -> None:
        with served(HeldSums(), HOLDABLE_SPEC) as url, contextlib.closing(Client(url)) as one:
            assert "memory" in one.metadata["supports"]
            for session in ("a", "b"):
                one.ask(endpoint="reset", session_id=session, seed=3, prompt="p")
            first = one.ask(**FRAME, session_id="a")["actions"]
            held = one.ask(endpoint="memory/get", session_id="a")
            assert held["status"] == "memory/get"
            second = one.ask(**FRAME, session_id="a")["actions"]
            assert not np.array_equal(first, second)
            assert (
                one.ask(endpoint="memory/set", session_id="b", memory=held["memory"])["status"]
                == "memory/set"
            )
            assert np.array_equal(one.ask(**FRAME, session_id="b")["actions"], second)

    @pytest.mark.parametrize(
        ("request_", "says"),
        [
            ({"endpoint": "memory/get", "session_id": "z"}, "'memory/get' without an episode"),
            ({"endpoint": "memory/set", "session_id": "z", "memory": {}}, "'memory/set' without an episode"),
            ({"endpoint": "memory/set"}, "expected a map of at most 1024 arrays, found NoneType"),
            ({"endpoint": "memory/set", "memory": {"sum": "1"}}, "found 'sum': str"),
            ({"endpoint": "memory/set", "memory": {}}, "expected 'sum' of shape (1,), found nothing"),
            ({"endpoint": "memory/set", "memory": {"sum": np.zeros(2)}}, "expected 'sum' of shape (1,)"),
        ],
    )
    def test_what_is_no_memory_is_refused_and_other_sessions_keep_theirs(
        self, request_: dict[str, Any], says: str
    ) -> None:
        with (
            served(HeldSums(), HOLDABLE_SPEC) as url,
            contextlib.closing(Client(url)) as other,
            contextlib.closing(Client(url)) as hostile,
        ):
            for one in (other, hostile):
                one.ask(endpoint="reset", seed=3, prompt="p")
            kept = other.ask(endpoint="memory/get")["memory"]["sum"]
            answer = hostile.ask(**request_)
            assert isinstance(answer, str) and says in answer
            assert other.ask(endpoint="memory/get")["memory"]["sum"] == kept

    def test_a_policy_without_it_refuses_both(self) -> None:
        with served(Sums()) as url:
            for endpoint in ("memory/get", "memory/set"):
                with contextlib.closing(Client(url)) as one:
                    assert "memory" not in one.metadata["supports"]
                    one.ask(endpoint="reset", seed=3, prompt="p")
                    answer = one.ask(endpoint=endpoint, memory={})
                    assert answer == f"'{endpoint}': policy 'sums' has no memory that can be read."

    def test_who_announces_a_memory_has_the_methods(self) -> None:
        with pytest.raises(client.SpecError, match="has no method get_memory"):
            client.PolicyServer(Sums(), HOLDABLE_SPEC, port=0)
