"""`check_remote` finds that `serve` keeps the protocol, alone and in passes of several rows."""

from collections.abc import Sequence
from typing import Literal

import pytest

from tests.serving.served_policies import CountingPolicy, serving
from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.errors import ConformanceError
from vla_eval.testing import check_remote


class MixedPolicy(CountingPolicy):
    """One count of frames for all slots."""

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        super().reset(episodes)
        self._total = 0

    def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        self._total += len(windows)
        chunks = super().act_batch(windows)
        for chunk in chunks:
            chunk.actions[:, 3] = self._total
        return chunks


@pytest.mark.parametrize("n_rows", [1, 4])
@pytest.mark.parametrize("reads", ["last", "every"])
def test_serve_keeps_the_protocol(reads: Literal["last", "every"], n_rows: int) -> None:
    with serving(CountingPolicy(reads=reads), n_rows=n_rows) as server:
        met = check_remote(server.url, timeout_seconds=10)
    assert "Two sessions side by side on one connection get what each gets alone." in met
    assert met[-1] == "After refused messages the server answers as before."


def test_a_policy_that_mixes_episodes_is_found_behind_serve() -> None:
    with (
        serving(MixedPolicy(), n_rows=2) as server,
        pytest.raises(ConformanceError, match="Two sessions side by side"),
    ):
        check_remote(server.url, timeout_seconds=10)
