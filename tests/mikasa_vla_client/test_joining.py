"""`mikasa_vla_client`: a policy whose chunks join what is committed is told of it, from the rollout on."""

from typing import Any

import numpy as np
import pytest

from tests.mikasa_vla_client.serving import client, served
from tests.policies.remote.test_remote_policy import make_env, starts
from tests.serving.test_committed import CHUNK, DIMS, SOUND, WRONG
from vla_eval.chunking import ChunkingSettings
from vla_eval.errors import ConformanceError
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.remote.policy import make_remote
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.testing.check_remote import check_remote

SPEC = client.PolicySpec(name="joins", chunk_size=CHUNK, state="joints", chunking_mode="rtc")


class Joins:
    """Goes on with the rows that are committed, then with its own number of the inference."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, int]] = []

    def reset(self, session: Any, episode: Any) -> None:
        session.memory = 0

    def infer(self, session: Any, observation: Any) -> Any:
        session.memory += 1
        rows = observation.get("committed/actions", np.zeros((0, DIMS), np.float32))
        self.heard.append((len(rows), observation.get("committed/n_frozen", 0)))
        own = np.full((CHUNK, DIMS), session.memory / 100, np.float32)
        return np.concatenate([rows, own])[:CHUNK]


@pytest.mark.parametrize("request_", WRONG.values(), ids=WRONG.keys())
def test_what_cannot_be_true_is_refused_as_by_the_program_s_own_server(request_: dict[str, Any]) -> None:
    state = np.array([0, 0, 0, 1, *[0] * 21], dtype=np.float32)
    with pytest.raises(ValueError, match="committed/"):
        SPEC.check_observation({**request_, "observation/state": state})
    SPEC.check_observation({**SOUND, "observation/state": state})


def test_a_policy_that_is_told_nothing_is_not_told_in_vain() -> None:
    with pytest.raises(ValueError, match="do not join what is committed"):
        client.PolicySpec(name="p", chunk_size=CHUNK).check_observation(SOUND)


def test_a_mode_that_does_not_exist_is_refused() -> None:
    with pytest.raises(client.SpecError, match="chunking_mode is 'wait', expected 'rtc' or 'prefix' or None"):
        client.PolicySpec(name="p", chunk_size=CHUNK, chunking_mode="wait")


def test_the_check_tries_it_and_what_is_no_chunk_is_named() -> None:
    with served(Joins(), SPEC) as url:
        met = check_remote(url)
    assert "A request may say what is committed; the answer is a chunk like any other." in met
    assert "Refused with a text: more frozen actions than committed ones." in met

    class Longer(Joins):
        def infer(self, session: Any, observation: Any) -> Any:
            rows = observation.get("committed/actions", np.zeros((0, DIMS), np.float32))
            return np.concatenate([rows, np.zeros((CHUNK, DIMS))])

    with served(Longer(), SPEC) as url, pytest.raises(ConformanceError, match="a request that keeps the"):
        check_remote(url)


def test_an_evaluation_tells_it_what_is_left_of_the_chunk_and_what_will_be_executed() -> None:
    joins = Joins()
    chunking = ChunkingSettings(mode="rtc", delay=1).at(2)
    env = make_env()
    with served(joins, SPEC) as url:
        context = PolicyContext(name="p", env=env.spec, chunking=chunking, n_candidates=3, n_slots=1)
        policy = make_remote(context, url=url)
        (record,) = rollout(env, policy, starts(1), RolloutSettings(chunking=chunking))
        policy.close()
    assert record.error is None
    # The first chunk joins nothing. Every later one is asked for after two steps of the one before, and
    # arrives one step later: of five rows three are left, of which one is executed meanwhile.
    assert joins.heard[0] == (0, 0)
    assert set(joins.heard[2:]) == {(3, 1)}
