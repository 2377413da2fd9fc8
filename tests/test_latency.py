"""Delays as data: what is drawn depends on the episode alone; what was measured can be played again."""

from collections import Counter

import pytest

from vla_eval.errors import RecipeError
from vla_eval.latency import DelayTrace, EpisodeDelays, VaryingDelay


def drawn(delay: VaryingDelay, *, seed: int, n: int = 8, trace: DelayTrace | None = None) -> list[int]:
    delays = EpisodeDelays(delay=delay, seed=seed, control_hz=20.0, trace=trace)
    return [delays.note(0.0) for _ in range(n)]


def test_a_number_is_the_delay_of_every_inference_whatever_it_took_here() -> None:
    delays = EpisodeDelays(delay=3, seed=1, control_hz=20.0)

    assert [delays.note(seconds) for seconds in (0.0, 9.0)] == [3, 3]
    assert delays.expected_steps == 3


def test_draws_depend_on_the_seed_and_the_number_of_the_inference_alone() -> None:
    delay = VaryingDelay(steps=(2, 3, 5), p=(0.5, 0.3, 0.2))
    several = {seed: drawn(delay, seed=seed) for seed in range(30)}

    assert several[7] == drawn(delay, seed=7)
    assert drawn(delay, seed=7, n=3) == several[7][:3]
    assert len({tuple(one) for one in several.values()}) > 20


def test_draws_follow_their_probabilities() -> None:
    delay = VaryingDelay(steps=(2, 3, 5), p=(0.5, 0.5, 0.0))
    counts = Counter(steps for seed in range(200) for steps in drawn(delay, seed=seed))

    assert set(counts) == {2, 3}
    assert 0.45 < counts[2] / 1600 < 0.55  # four standard deviations of 0.0125


@pytest.mark.parametrize(
    ("seconds", "steps"), [(0.0, 0), (0.001, 1), (0.05, 1), (0.0501, 2), (0.2, 4), (1e9, 10_000)]
)
def test_measured_seconds_are_rounded_up_to_control_steps(seconds: float, steps: int) -> None:
    delays = EpisodeDelays(delay="measured", seed=1, control_hz=20.0)

    assert delays.note(seconds) == steps
    assert delays.steps == [steps]


class TestTraces:
    DELAYS = {  # noqa: RUF012  # read only
        ("A", "fast", 4, 0, 1): (1, 2),
        ("A", "fast", 8, 0, 1): (3,),
        ("B", "fast", 4, 0, 1): (4,),
        ("A", "slow", 4, 0, 1): (9, 9),
    }

    def narrowed(self, task: str, policy: str, n_action_steps: int) -> DelayTrace:
        return DelayTrace.narrowed(self.DELAYS, task=task, policy=policy, n_action_steps=n_action_steps)

    def test_an_episode_of_the_trace_has_its_own_delays_and_then_draws(self) -> None:
        trace = self.narrowed("A", "fast", 4)
        found = drawn(VaryingDelay(trace="runs/x"), seed=1, n=40, trace=trace)

        assert found[:2] == [1, 2]
        assert set(found[2:]) == {1, 2, 4}  # of `fast` at 4, on any task

    @pytest.mark.parametrize(
        ("row", "pool"),
        [
            (("C", "fast", 4), (1, 2, 4)),
            (("C", "fast", 16), (1, 2, 3, 4)),
            (("A", "other", 4), (1, 2, 3, 4, 9, 9)),
        ],
    )
    def test_the_pool_is_that_of_the_most_alike_episodes(
        self, row: tuple[str, str, int], pool: tuple[int, ...]
    ) -> None:
        trace = self.narrowed(*row)

        assert trace.episodes == {}
        assert trace.pool == pool

    def test_the_order_of_records_does_not_matter(self) -> None:
        turned = dict(reversed(self.DELAYS.items()))

        found = DelayTrace.narrowed(turned, task="C", policy="other", n_action_steps=4)
        assert found.pool == self.narrowed("C", "other", 4).pool


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({}, "expected either steps or trace, found neither"),
        ({"steps": (1,), "trace": "x"}, "expected either steps or trace, found both"),
        ({"trace": "x", "p": (1.0,)}, "none beside a trace"),
        ({"steps": (-1,)}, "numbers from 0"),
        ({"steps": (1, 20_000)}, "numbers from 0 to 10,000"),
        ({"steps": (1, 2), "p": (1.0,)}, "2 probabilities"),
        ({"steps": (1, 2), "p": (0.7, 0.7)}, "whose sum is 1"),
        ({"steps": (1, 2), "p": (1.5, -0.5)}, "whose sum is 1"),
    ],
)
def test_what_is_no_delay_is_refused(given: dict[str, object], problem: str) -> None:
    with pytest.raises(RecipeError, match=rf"chunking\.delay.*{problem}"):
        VaryingDelay(**given)  # type: ignore[arg-type]
