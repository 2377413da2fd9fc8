"""Batching: passes, rows, fairness, and errors that stay with the session that causes them."""

import contextlib
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future
from typing import Any

import numpy as np
import pytest

from tests.serving.served_policies import CountingPolicy, OneByOnePolicy
from vla_eval.core import EpisodeStart, Observation, ObservationWindow
from vla_eval.features import ACTION_NAMES
from vla_eval.serving.batching import Batcher, Inference, PolicyFailure
from vla_eval.serving.metrics import ServerMetrics

SECONDS = 10.0


@contextlib.contextmanager
def batching(policy: Any, *, n_rows: int = 4) -> Iterator[Batcher]:
    batcher = Batcher(policy, n_rows=n_rows, action_dims=ACTION_NAMES, metrics=ServerMetrics())
    try:
        yield batcher
    finally:
        batcher.close()


def begin(batcher: Batcher, seed: int, *, row: int | None = None, instruction: str = "look") -> EpisodeStart:
    """Begin the episode of a seed in the slot of that number."""
    start = EpisodeStart(
        slot=seed,
        task="any",
        seed=seed,
        run=0,
        instruction=instruction,
        horizon_steps=9,
        row=seed if row is None else row,
    )
    batcher.begin(start)
    return start


def infer(batcher: Batcher, start: EpisodeStart, *, step: int = 0) -> Future[Inference]:
    state = {"qpos": np.zeros(9, dtype=np.float32)}
    frames = (Observation(step=step, images={}, state=state),)
    return batcher.infer(start, ObservationWindow(slot=start.slot, frames=frames))


def answer(future: Future[Inference]) -> tuple[float, ...]:
    """Return seed, step and number of frames."""
    return tuple(float(value) for value in future.result(SECONDS).chunk.actions[0, :3])


class TestPasses:
    def test_an_idle_policy_is_asked_at_once(self) -> None:
        policy = CountingPolicy()
        with batching(policy) as batcher:
            one, two = begin(batcher, 0), begin(batcher, 1)
            assert answer(infer(batcher, one)) == (0, 0, 1)  # nobody else has asked
            assert answer(infer(batcher, two)) == (1, 0, 1)
        assert policy.passes == [[0], [1]]

    def test_what_arrives_during_a_pass_shares_the_next_one(self) -> None:
        policy = CountingPolicy()
        with batching(policy) as batcher:
            starts = [begin(batcher, seed) for seed in range(4)]
            policy.hold.clear()
            first = infer(batcher, starts[0])
            assert policy.begun.wait(SECONDS)
            others = [infer(batcher, start) for start in starts[1:]]
            policy.hold.set()
            assert [answer(future) for future in (first, *others)] == [(seed, 0, 1) for seed in range(4)]
        assert policy.passes == [[0], [1, 2, 3]]

    def test_two_sessions_of_one_row_are_never_in_one_pass(self) -> None:
        policy = CountingPolicy()
        with batching(policy) as batcher:
            starts = [begin(batcher, seed, row=seed % 2) for seed in range(5)]
            policy.hold.clear()
            first = infer(batcher, starts[0])
            assert policy.begun.wait(SECONDS)
            others = [infer(batcher, starts[seed]) for seed in (1, 3, 2, 4)]
            policy.hold.set()
            for future in (first, *others):
                future.result(SECONDS)
        # 3 has the row of 1, 4 that of 2: oldest first in each pass.
        assert policy.passes == [[0], [1, 2], [3, 4]]

    def test_a_policy_that_cannot_batch_is_asked_one_by_one(self) -> None:
        policy = OneByOnePolicy()
        with batching(policy, n_rows=1) as batcher:
            starts = [begin(batcher, seed, row=0) for seed in range(3)]
            futures = [infer(batcher, start) for start in starts]
            assert [answer(future) for future in futures] == [(seed, 0, 1) for seed in range(3)]
        assert policy.inner.passes == [[0], [1], [2]]

    def test_requests_of_a_session_keep_their_order(self) -> None:
        policy = CountingPolicy()
        with batching(policy) as batcher:
            start = begin(batcher, 0)
            policy.hold.clear()
            futures = [infer(batcher, start, step=step) for step in (0, 1)]
            again = begin(batcher, 0)  # forgets the frames of the two before
            futures.append(infer(batcher, again, step=0))
            policy.hold.set()
            assert [answer(future) for future in futures] == [(0, 0, 1), (0, 1, 2), (0, 0, 1)]

    def test_an_answer_is_the_same_whoever_else_asks(self) -> None:
        def run(seeds: list[int]) -> list[tuple[float, ...]]:
            policy = CountingPolicy()
            with batching(policy) as batcher:
                starts = [begin(batcher, seed) for seed in seeds]
                steps = [[infer(batcher, start, step=step) for start in starts] for step in range(3)]
                return [answer(futures[0]) for futures in steps]

        assert run([3]) == run([3, 0, 1, 2])


class TestErrors:
    def test_an_error_is_that_of_one_session(self) -> None:
        policy = CountingPolicy(bad_seed=1)
        with batching(policy) as batcher:
            starts = [begin(batcher, seed) for seed in range(4)]
            policy.hold.clear()
            first = infer(batcher, starts[0])
            assert policy.begun.wait(SECONDS)
            one, two, three = (infer(batcher, start) for start in starts[1:])
            policy.hold.set()
            with pytest.raises(PolicyFailure, match="ArithmeticError: a bad episode"):
                one.result(SECONDS)
            assert [answer(future) for future in (first, two, three)] == [(0, 0, 1), (2, 0, 1), (3, 0, 1)]
        assert policy.passes == [[0], [1, 2, 3], [1], [2], [3]]

    def test_the_thread_survives_a_policy_that_exits(self) -> None:
        class Exits(CountingPolicy):
            def act_batch(self, windows: Any) -> Any:
                raise SystemExit(3)

        with batching(Exits()) as batcher:
            start = begin(batcher, 0)
            for _ in range(2):
                with pytest.raises(PolicyFailure, match="SystemExit: 3"):
                    infer(batcher, start).result(SECONDS)

    def test_an_episode_that_cannot_be_begun_is_not_continued_with_the_one_before(self) -> None:
        with batching(CountingPolicy()) as batcher:
            start = begin(batcher, 0)
            answer(infer(batcher, start))
            refused = begin(batcher, 0, instruction="refuse")
            with pytest.raises(PolicyFailure, match="no such task"):
                infer(batcher, refused).result(SECONDS)
            assert answer(infer(batcher, begin(batcher, 0))) == (0, 0, 1)


def test_closing_finishes_the_pass_under_way_and_no_other() -> None:
    policy = CountingPolicy()
    batcher = Batcher(policy, n_rows=4, action_dims=ACTION_NAMES, metrics=ServerMetrics())
    start = begin(batcher, 0)
    policy.hold.clear()
    running, waiting = infer(batcher, start), infer(batcher, start, step=1)
    assert policy.begun.wait(SECONDS)
    closing = threading.Thread(target=batcher.close)
    closing.start()
    while not waiting.cancelled():  # closing has begun
        time.sleep(0.001)
    policy.hold.set()
    closing.join(SECONDS)

    assert answer(running) == (0, 0, 1)
    with pytest.raises(CancelledError):
        waiting.result(SECONDS)
