"""What is committed, on its way to a server: read as it was sent, and refused if it cannot be true."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.policies.remote.test_remote_policy import remote
from tests.wire.hostile_numbers import hostile_scalars, hostile_vectors
from tests.wire.small_servers import OURS, SmallServer
from vla_eval.chunking import ChunkingSettings
from vla_eval.errors import SpecMismatchError
from vla_eval.serving.host import HostOptions, host_policy
from vla_eval.serving.observations import RequestError, observation_reader
from vla_eval.specs import PolicySpec
from vla_eval.tasks.interface import env_spec
from vla_eval.wire.codec import packb, unpackb
from vla_eval.wire.metadata import ServerMetadata

CHUNK, DIMS = 5, 7
ROWS = np.linspace(-1, 1, 3 * DIMS, dtype=np.float32).reshape(3, DIMS)
SOUND: dict[str, Any] = {"committed/actions": ROWS, "committed/n_frozen": 2}


def reader(*, joins: bool = True) -> Any:
    spec = PolicySpec(name="p", reads="last", cameras=(), states=(), chunk_size=CHUNK, reads_committed=joins)
    return observation_reader(spec, env_spec(), end_effector=False)


def test_it_is_read_to_the_bit() -> None:
    found = reader().read_committed(unpackb(packb(SOUND)))

    assert found.actions.tobytes() == ROWS.tobytes()
    assert found.n_frozen == 2


def test_a_request_that_says_nothing_is_one_at_which_nothing_is_committed() -> None:
    found = reader().read_committed({})

    assert (found.actions.shape, found.n_frozen) == ((0, DIMS), 0)
    assert reader(joins=False).read_committed({}) is None


def wrong_requests() -> Iterator[tuple[str, dict[str, Any]]]:
    for name, flat in hostile_vectors(ROWS.flatten()):
        if isinstance(flat, np.ndarray) and flat.size == ROWS.size:
            yield f"actions: {name}", {**SOUND, "committed/actions": flat.reshape(ROWS.shape)}
    for name, number in hostile_scalars():
        yield f"n_frozen: {name}", {**SOUND, "committed/n_frozen": number}
    for name, actions in {
        "other numbers": ROWS[:, :6],
        "one row alone": ROWS[0],
        "more rows than a chunk": np.zeros((CHUNK + 1, DIMS), np.float32),
        "a list": ROWS.tolist(),
        "half precision": ROWS.astype(np.float16),
    }.items():
        yield f"actions: {name}", {**SOUND, "committed/actions": actions}
    for n_frozen in (-1, 4, 1.5, True, "2"):
        yield f"n_frozen: {n_frozen!r}", {**SOUND, "committed/n_frozen": n_frozen}
    for key in SOUND:
        yield f"no {key}", {name: value for name, value in SOUND.items() if name != key}


WRONG = dict(wrong_requests())


@pytest.mark.parametrize("request_", WRONG.values(), ids=WRONG.keys())
def test_what_cannot_be_true_is_refused(request_: dict[str, Any]) -> None:
    with pytest.raises(RequestError, match="committed/"):
        reader().read_committed(request_)


def test_a_policy_that_is_told_nothing_is_not_told_in_vain() -> None:
    with pytest.raises(RequestError, match=r"do not join what is committed.*--chunking-mode"):
        reader(joins=False).read_committed(SOUND)


def test_a_server_says_by_which_mode_its_chunks_join_and_others_say_nothing() -> None:
    said = ServerMetadata(protocol="openpi+1", chunking_mode="rtc").to_wire()

    assert ServerMetadata.from_wire(said, where="here").chunking_mode == "rtc"
    assert "chunking_mode" not in ServerMetadata(protocol="openpi+1").to_wire()
    hosted = host_policy(HostOptions(policy="random", chunking=ChunkingSettings(mode="wait", delay=3)))
    assert hosted.metadata.chunking_mode is None


@pytest.mark.parametrize(
    ("said", "mode", "problem"),
    [
        ({"chunking_mode": "rtc"}, "receding_horizon", "Start it without --chunking-mode"),
        ({"chunking_mode": "prefix"}, "rtc", "the server's mode is prefix.*--chunking-mode rtc"),
        ({}, "rtc", "the server's mode is none of these.*--chunking-mode rtc"),
    ],
)
def test_a_server_of_another_mode_is_refused(said: dict[str, Any], mode: Any, problem: str) -> None:
    with (
        pytest.raises(SpecMismatchError, match=problem),
        remote(SmallServer(**OURS, **said), chunking=ChunkingSettings(mode=mode)),
    ):
        pass
