"""Numbers of any field that are not finite or of another type: an error at both ends, never an answer."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import connect

from tests.mikasa_vla_client.serving import client as plugin
from tests.mikasa_vla_client.serving import served
from tests.policies.remote.test_remote_policy import answering, echo, remote, run, starts
from tests.serving.served_policies import CHUNK_SIZE, CountingPolicy, serving
from tests.wire.hostile_numbers import hostile_scalars, hostile_vectors, packed
from tests.wire.small_servers import OURS, SmallServer, some_actions
from vla_eval.core import ActionChunk, Observation, ObservationWindow
from vla_eval.errors import InvalidActionError, RemotePolicyError, SimulationError, VlaEvalError
from vla_eval.features import ACTION_NAMES
from vla_eval.policies.remote.actions import as_rows
from vla_eval.specs import PolicySpec
from vla_eval.wire.codec import CodecError, unpackb
from vla_eval.wire.metadata import ServerMetadata

POSE = (0.1, 0.0, 0.2, 0.0, 1.0, 0.0, 0.0)
STATE = np.array([*POSE, *[0.0] * 18], dtype=np.float32)
IMAGE = np.zeros((128, 128, 3), np.uint8)
FRAME = {"observation/image": IMAGE, "observation/state": STATE, "prompt": "look", "step": 0}
QUATERNIONS = ((0, 0, 0, 0), (1e-30, 0, 0, 0), (1e38, 1e38, 0, 0), (0.5, 0.5, 0, 0))
SHAPE = (CHUNK_SIZE, len(ACTION_NAMES))
ZEROS = np.zeros(SHAPE, np.float32)
COUNTS = ("step", "seed", "run", "row", "horizon_steps")


class StatePolicy(CountingPolicy):
    """Reads the state, and gives what `answer` makes of its pose."""

    def __init__(self, answer: Callable[[np.ndarray], Any] = lambda _: ZEROS) -> None:
        super().__init__()
        self.spec = PolicySpec(
            name="reading",
            reads="last",
            cameras=("base_camera",),
            states=("tcp_pose", "qpos", "qvel"),
            chunk_size=CHUNK_SIZE,
        )
        self.n_asked, self._answer = 0, answer

    def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        self.n_asked += len(windows)
        poses = [window.last.state["tcp_pose"] for window in windows]
        return [ActionChunk(actions=self._answer(pose)) for pose in poses]


def with_quaternion(quaternion: tuple[float, ...]) -> np.ndarray:
    return np.concatenate([STATE[:3], quaternion, STATE[7:]]).astype(np.float32)


def hostile_requests() -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield requests with one number that is none."""
    for name, state in hostile_vectors(STATE):
        yield f"state: {name}", {**FRAME, "observation/state": state}
    for quaternion in QUATERNIONS:
        yield f"quaternion: {quaternion}", {**FRAME, "observation/state": with_quaternion(quaternion)}
    for name, image in hostile_vectors(IMAGE[:1].astype(np.float32)):
        whole = np.broadcast_to(image, IMAGE.shape) if isinstance(image, np.ndarray) else image
        yield f"image: {name}", {**FRAME, "observation/image": whole}


def answer_to(url: str, *requests: bytes) -> Any:
    """Return the reply to the last request of a connection of its own."""
    with connect(url, compression=None, max_size=None) as socket:
        socket.recv(timeout=10)
        for request in requests:
            socket.send(request)
            reply = socket.recv(timeout=10)
            if isinstance(reply, str):
                return reply
        return unpackb(reply) if isinstance(reply, bytes) else reply


class TestOurServer:
    def test_a_number_of_an_observation_that_is_none_is_an_error_and_never_reaches_the_policy(self) -> None:
        policy = StatePolicy()
        with serving(policy) as server:
            assert answer_to(server.url, packed(FRAME))["actions"].shape == SHAPE
            requests = list(hostile_requests())
            for name, request in requests:
                answer = answer_to(server.url, packed(request))
                assert isinstance(answer, str), name
                assert "expected" in answer and "Traceback" not in answer, name
        assert policy.n_asked == 1 and len(requests) > 40

    def test_a_count_that_is_none_is_an_error(self) -> None:
        with serving(StatePolicy()) as server:
            for name, number in hostile_scalars():
                for field in COUNTS:
                    answer = answer_to(server.url, packed({**FRAME, "endpoint": "reset", field: number}))
                    assert isinstance(answer, str), (field, name)
                answer = answer_to(
                    server.url,
                    packed({"endpoint": "reset", "prompt": "look"}),
                    packed({**FRAME, "step": number}),
                )
                assert isinstance(answer, str), name

    def test_an_action_that_is_none_is_an_error(self) -> None:
        hostile = [
            *hostile_vectors(ZEROS),
            ("shape", ZEROS[:1]),
            ("none", None),
            ("float64", ZEROS.astype(float)),
        ]
        answers = iter([actions for _, actions in hostile])
        with serving(StatePolicy(lambda _: next(answers))) as server:
            for name, _ in hostile:
                answer = answer_to(server.url, packed(FRAME))
                assert isinstance(answer, str), name
                assert "expected an ActionChunk of shape (2, 7), float32, all finite" in answer, name

    def test_a_state_that_overflows_in_the_policy_is_an_error_of_that_session_alone(self) -> None:
        def divided(pose: np.ndarray) -> np.ndarray:
            with np.errstate(over="ignore"):
                return np.full(SHAPE, pose[0] * np.float32(1e30), np.float32)

        policy = StatePolicy(divided)
        absurd = STATE.copy()
        absurd[0] = 3e38
        with serving(policy) as server:
            answer = answer_to(server.url, packed({**FRAME, "observation/state": absurd}))
            assert "InvalidActionError" in answer and "found inf at row 0, dimension 'dx'" in answer
            assert policy.n_asked == 1  # it is not asked again: it has seen the frame
            assert np.isfinite(answer_to(server.url, packed(FRAME))["actions"]).all()


class TestThePluginsServer:
    SPEC = plugin.PolicySpec(name="p", chunk_size=CHUNK_SIZE, cameras=("base_camera",), state="joints")

    def test_a_number_of_an_observation_that_is_none_is_an_error_and_never_reaches_the_policy(self) -> None:
        asked = []

        def policy(observation: Any) -> Any:
            asked.append(observation)
            return ZEROS

        with served(policy, self.SPEC) as url:
            assert answer_to(url, packed(FRAME))["actions"].shape == SHAPE
            for name, request in hostile_requests():
                answer = answer_to(url, packed(request))
                assert isinstance(answer, str) and "expected" in answer, name
        assert len(asked) == 1

    def test_a_count_that_is_none_is_an_error(self) -> None:
        with served(lambda _: ZEROS, self.SPEC) as url:
            for name, number in hostile_scalars():
                for field in ("seed", "run", "horizon_steps"):
                    answer = answer_to(url, packed({**FRAME, "endpoint": "reset", field: number}))
                    assert isinstance(answer, str), (field, name)
                answer = answer_to(url, packed({**FRAME, "step": number}))
                assert isinstance(answer, str), name  # it would be repeated in the reply

    def test_an_action_that_is_none_is_an_error(self) -> None:
        exact = ("float16", "longdouble")  # become the same numbers in float32
        hostile = [*hostile_vectors(ZEROS, allowed=exact), ("bool", ZEROS.astype(bool))]
        answers = iter([actions for _, actions in hostile])
        with served(lambda _: next(answers), self.SPEC) as url:
            for name, _ in hostile:
                answer = answer_to(url, packed(FRAME))
                assert isinstance(answer, str) and "returned actions" in answer, name


class TestTheClient:
    def test_actions_that_are_none_are_an_error(self) -> None:
        good = some_actions(0, 0)
        for name, actions in hostile_vectors(good, allowed=("float16",)):  # float32 holds all of float16
            if isinstance(actions, list):
                actions = np.array(actions).reshape(good.shape).tolist()

            def reply(one: dict[str, Any], actions: Any = actions) -> bytes:
                return packed(echo(one, actions=actions))

            with remote(answering(reply)) as policy, pytest.raises((InvalidActionError, RemotePolicyError)):
                run(policy, 7)
                raise AssertionError(name)

    def test_lists_hold_numbers_alone(self) -> None:
        for bad in ([["1"]], [[None]], [[True]], [[b"1"]], [[1j]], [[2**70]], [["nan"]]):
            rows = as_rows(bad)
            assert not isinstance(rows, np.ndarray) or rows.dtype != np.float32, bad
        assert as_rows([[1, 2.5]]).dtype == as_rows([[1, 2]]).dtype == np.float32

    def test_a_state_that_is_none_is_not_sent(self) -> None:
        server = SmallServer()
        good = {"tcp_pose": STATE[:7], "qpos": STATE[7:16], "qvel": STATE[16:]}
        with remote(server) as policy:
            policy.reset(starts(7))
            n_before = len(server.requests)
            for part, values in good.items():
                for name, bad in hostile_vectors(values):
                    with pytest.raises(SimulationError, match=f"state '{part}'"):
                        policy.act(window_of({**good, part: bad}))
                        raise AssertionError(name)
            for quaternion in QUATERNIONS:
                with pytest.raises(SimulationError, match="expected a quaternion"):
                    policy.act(window_of({**good, "tcp_pose": with_quaternion(quaternion)[:7]}))
            assert len(server.requests) == n_before
            assert policy.act(window_of(good)).actions.dtype == np.float32

    def test_what_a_server_says_of_itself_holds_no_such_number(self) -> None:
        camera = {"key": "observation/image", "height_px": 128, "width_px": 128}
        for name, number in hostile_scalars():
            changes = [
                {field: number} for field in ("chunk_size", "n_action_steps", "batch_max", "n_sessions")
            ]
            changes += [
                {"cameras": {"base_camera": {**camera, side: number}}} for side in ("height_px", "width_px")
            ]
            if name != "a fraction":
                changes.append({"control_hz": number})
            for change in changes:
                with pytest.raises((VlaEvalError, CodecError)):
                    ServerMetadata.from_wire(unpackb(packed({**OURS, **change})), where="ws://here")
                    raise AssertionError((name, change))


def window_of(state: dict[str, Any]) -> ObservationWindow:
    return ObservationWindow(slot=0, frames=(Observation(step=0, images={}, state=state),))
