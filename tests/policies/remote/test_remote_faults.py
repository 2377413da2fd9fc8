"""A server of a remote policy that answers with an error, or too late."""

import time
from typing import Any

import pytest

from tests.policies.remote.test_remote_policy import answering, echo, remote, run, window
from vla_eval.errors import RemoteConnectionError, RemoteReplyError, RemoteTimeoutError


def test_an_error_of_the_server_ends_the_episode_with_its_words() -> None:
    with (
        remote(answering(lambda one: "the state has a wrong length")) as policy,
        pytest.raises(RemoteReplyError, match="the state has a wrong length"),
    ):
        run(policy, 7)


def test_a_reply_after_the_timeout_is_never_used() -> None:
    def late(request: dict[str, Any]) -> Any:
        time.sleep(0.4)
        return echo(request)

    with remote(answering(late), timeout_seconds=0.1) as policy:
        with pytest.raises(RemoteTimeoutError):
            run(policy, 7)
        time.sleep(0.5)
        with pytest.raises(RemoteConnectionError):
            policy.act(window(0))
