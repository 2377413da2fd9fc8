"""Chunk execution, with actions that carry their own origin: 100 * inference step + row."""

import math

import numpy as np
import pytest

from vla_eval.chunking import EXECUTIONS, ChunkExecutor, ChunkingSpec, Mode
from vla_eval.core import ActionChunk
from vla_eval.errors import RecipeError, SpecMismatchError
from vla_eval.latency import DelayTrace, EpisodeDelays, VaryingDelay


def chunk(step: int, size: int) -> ActionChunk:
    return ActionChunk(actions=np.array([[100 * step + row] for row in range(size)], dtype=np.float32))


def executing(spec: ChunkingSpec, *, played: tuple[int, ...] = ()) -> ChunkExecutor:
    trace = DelayTrace(episodes={(0, 1): played}, pool=(0,))
    return ChunkExecutor(spec, EpisodeDelays(delay=spec.delay, seed=1, control_hz=20.0, trace=trace))


def executed(
    spec: ChunkingSpec, *, size: int, n_steps: int, played: tuple[int, ...] = ()
) -> list[float | None]:
    executor = executing(spec, played=played)
    actions: list[float | None] = []
    for step in range(n_steps):
        if step == executor.next_inference_step:
            executor.submit(step, chunk(step, size), seconds=0.0)
        found = executor.action(step)
        actions.append(None if found is None else float(found.action[0]))
    return actions


def test_only_the_first_n_action_steps_of_a_chunk_are_executed() -> None:
    spec = ChunkingSpec(n_action_steps=2)

    # Chunks of 4 at steps 0, 2, 4; of each, rows 0 and 1.
    assert executed(spec, size=4, n_steps=6) == [0, 1, 200, 201, 400, 401]


def test_a_whole_chunk_is_executed_open_loop() -> None:
    assert executed(ChunkingSpec(n_action_steps=3), size=3, n_steps=7) == [0, 1, 2, 300, 301, 302, 600]


def test_inferences_come_every_n_action_steps() -> None:
    executor = executing(ChunkingSpec(n_action_steps=3))
    inferred_at = []
    for step in range(8):
        if step == executor.next_inference_step:
            inferred_at.append(step)
            executor.submit(step, chunk(step, 3), seconds=0.0)

    assert inferred_at == [0, 3, 6]


def test_a_delay_with_skip_drops_what_is_past() -> None:
    spec = ChunkingSpec(n_action_steps=2, delay=1, delay_alignment="skip")

    # Nothing has arrived at step 0. The chunk of step 0 (rows for steps 0, 1, 2) is usable from step 1:
    # rows 1, 2. The chunk of step 2 is usable from step 3: rows 1, 2 again.
    assert executed(spec, size=3, n_steps=5) == [None, 1, 2, 201, 202]


def test_a_delay_with_stale_executes_the_whole_chunk_late() -> None:
    spec = ChunkingSpec(n_action_steps=2, delay=1, delay_alignment="stale")

    assert executed(spec, size=2, n_steps=5) == [None, 0, 1, 200, 201]


def test_one_inference_runs_at_a_time_however_long_it_takes() -> None:
    spec = ChunkingSpec(n_action_steps=1, delay=3)

    # Inferences at 0, 3, 6. The chunk of step 0 arrives at step 3 with rows 3, 4, 5 left, until that of step
    # 3 arrives at step 6.
    assert executed(spec, size=6, n_steps=8) == [None, None, None, 3, 4, 5, 303, 304]


def test_the_ensemble_averages_all_chunks_that_cover_a_step() -> None:
    spec = ChunkingSpec(n_action_steps=1, mode="temporal_ensemble", ensemble_decay=0.5)

    actions = executed(spec, size=2, n_steps=3)

    # Step 0: chunk 0 alone. Step s >= 1: chunk s-1 (older, weight e^0) says 100 (s-1) + 1, chunk s
    # (weight e^-0.5) says 100 s.
    older, newer = 1.0, math.exp(-0.5)
    assert actions[0] == 0
    assert actions[1] == pytest.approx((older * 1 + newer * 100) / (older + newer))
    assert actions[2] == pytest.approx((older * 101 + newer * 200) / (older + newer))


def test_the_ensemble_changes_the_executed_actions() -> None:
    receding = executed(ChunkingSpec(n_action_steps=1), size=3, n_steps=4)
    ensemble = executed(ChunkingSpec(n_action_steps=1, mode="temporal_ensemble"), size=3, n_steps=4)

    assert receding == [0, 100, 200, 300]
    assert ensemble[0] == receding[0]
    assert all(a != b for a, b in zip(ensemble[1:], receding[1:], strict=True))


def test_the_ensemble_respects_the_interval_and_the_delay() -> None:
    spec = ChunkingSpec(n_action_steps=2, delay=1, mode="temporal_ensemble", ensemble_decay=0.0)

    # Inferences at 0 and 2, chunks of 4. Step 1, 2: chunk 0 rows 1, 2. Step 3: chunk 0 row 3 and chunk 2
    # row 1, equal weights: (3 + 201) / 2.
    assert executed(spec, size=4, n_steps=4) == [None, 1, 2, 102]


def test_executed_actions_are_no_views_of_the_policy_s_array() -> None:
    given = chunk(0, 2)
    executor = executing(ChunkingSpec(n_action_steps=2))
    executor.submit(0, given, seconds=0.0)
    given.actions[:] = -1  # a policy that reuses its buffer

    found = executor.action(0)
    assert found is not None
    found.action[:] = -2
    again = executor.action(0)

    assert again is not None
    assert again.action[0] == 0


def test_the_first_inference_may_be_late_and_all_others_follow_it_by_n_action_steps() -> None:
    spec = ChunkingSpec(n_action_steps=3, first_inference_step=2)

    # Nothing to execute at steps 0 and 1; chunks at steps 2 and 5.
    assert executed(spec, size=3, n_steps=7) == [None, None, 200, 201, 202, 500, 501]
    assert executing(spec).next_inference_step == 2


def test_a_first_inference_that_repeats_an_earlier_rhythm_is_refused() -> None:
    ChunkingSpec(n_action_steps=3, first_inference_step=2)
    with pytest.raises(RecipeError, match=r"first_inference_step is 3, expected less than .* which is 3"):
        ChunkingSpec(n_action_steps=3, first_inference_step=3)


@pytest.mark.parametrize(
    ("field", "value"),
    [("n_action_steps", 0), ("delay", -1), ("ensemble_decay", -0.1), ("first_inference_step", -1)],
)
def test_values_out_of_range_are_refused(field: str, value: float) -> None:
    with pytest.raises(RecipeError, match=rf"chunking\.{field} is {value}, expected a number ≥"):
        ChunkingSpec(**{"n_action_steps": 1, field: value})


def test_a_chunk_too_short_for_the_delay_is_refused() -> None:
    spec = ChunkingSpec(n_action_steps=4, delay=2)

    spec.check_chunk_size(6, policy="p")
    with pytest.raises(SpecMismatchError, match=r"'p' predicts chunks of 5 .* needs 6"):
        spec.check_chunk_size(5, policy="p")


PLAYED = VaryingDelay(trace="runs/another")


class TestVaryingDelays:
    def test_until_a_late_chunk_arrives_the_one_before_continues(self) -> None:
        spec = ChunkingSpec(n_action_steps=2, delay=PLAYED)

        # Inferences at 0, 2, 4, 6 take 0, 2, 1, 0 steps. Step 2, 3: rows 2, 3 of chunk 0. Chunk 2 arrives at
        # step 4 with row 2, chunk 4 at step 5 with row 1.
        found = executed(spec, size=4, n_steps=8, played=(0, 2, 1, 0))
        assert found == [0, 1, 2, 3, 202, 401, 600, 601]

    def test_where_nothing_is_left_the_arm_holds(self) -> None:
        spec = ChunkingSpec(n_action_steps=2, delay=PLAYED)

        # As before, but chunk 0 has no row 3.
        found = executed(spec, size=3, n_steps=6, played=(0, 2, 1, 0))
        assert found == [0, 1, 2, None, 202, 401]

    def test_a_chunk_that_arrives_after_its_last_step_is_never_executed(self) -> None:
        spec = ChunkingSpec(n_action_steps=2, delay=PLAYED)

        # The chunk of step 2 arrives at step 6; its rows are for steps 2 and 3.
        found = executed(spec, size=2, n_steps=8, played=(0, 4, 0))
        assert found == [0, 1, None, None, None, None, 600, 601]

    def test_a_stale_chunk_is_executed_whole_whenever_it_arrives(self) -> None:
        spec = ChunkingSpec(n_action_steps=2, delay=PLAYED, delay_alignment="stale")

        # Inferences at 0, 3, 5: chunk 0 arrives at 3, chunk 3 at 4, chunk 5 at 5.
        assert executed(spec, size=2, n_steps=7, played=(3, 1, 0)) == [None, None, None, 0, 300, 500, 501]

    def test_a_delay_that_varies_is_refused_only_if_its_shortest_is_too_long(self) -> None:
        spec = ChunkingSpec(n_action_steps=2, delay=VaryingDelay(steps=(1, 5)))

        spec.check_chunk_size(3, policy="p")
        with pytest.raises(SpecMismatchError, match=r"chunks of 2 .* delay of 1 steps .* needs 3"):
            spec.check_chunk_size(2, policy="p")
        assert spec.planned_rows == 10  # 5 are over when it arrives, and 5 pass until the next one does


class TestWaiting:
    def test_the_arm_holds_while_it_thinks_and_executes_each_chunk_from_its_first_action(self) -> None:
        spec = ChunkingSpec(n_action_steps=2, mode="wait", delay=1)

        # Inferences at 0, 3, 6, in the step of each the arm holds.
        assert executed(spec, size=5, n_steps=8) == [None, 0, 1, None, 300, 301, None, 600]

    def test_without_a_delay_it_is_receding_horizon(self) -> None:
        waiting = executed(ChunkingSpec(n_action_steps=2, mode="wait"), size=3, n_steps=6)

        assert waiting == executed(ChunkingSpec(n_action_steps=2), size=3, n_steps=6)

    def test_a_chunk_has_to_be_no_longer_than_what_is_executed(self) -> None:
        ChunkingSpec(n_action_steps=4, mode="wait", delay=9).check_chunk_size(4, policy="p")


COMMITTING = [mode for mode, execution in EXECUTIONS.items() if execution.commits]


class TestCommitted:
    @pytest.mark.parametrize("mode", COMMITTING)
    def test_the_policy_is_told_what_is_left_of_the_chunk_under_way(self, mode: Mode) -> None:
        executor = executing(ChunkingSpec(n_action_steps=2, mode=mode, delay=1))
        first = executor.committed(0, n_dims=1)
        executor.submit(0, chunk(0, 5), seconds=0.0)
        second = executor.committed(2, n_dims=1)

        assert first is not None
        assert (first.actions.shape, first.n_frozen) == ((0, 1), 0)
        # Of chunk 0, rows 2, 3, 4 are left; row 2 will be executed before a chunk of step 2 can arrive.
        assert second is not None
        assert second.actions[:, 0].tolist() == [2, 3, 4]
        assert second.n_frozen == 1

    @pytest.mark.parametrize("mode", COMMITTING)
    def test_what_was_committed_is_what_is_executed_until_the_new_chunk_arrives(self, mode: Mode) -> None:
        executor = executing(ChunkingSpec(n_action_steps=4, mode=mode, delay=2))
        for step in range(12):
            if step == executor.next_inference_step:
                told = executor.committed(step, n_dims=1)
                executor.submit(step, chunk(step, 8), seconds=0.0)
                assert told is not None
                expected = told.actions[: told.n_frozen, 0].tolist()
                found = [executor.action(s) for s in (step, step + 1)]
                assert [float(one.action[0]) for one in found if one is not None] == expected

    def test_a_varying_delay_is_expected_to_be_as_long_as_the_longest_of_the_last_ten(self) -> None:
        executor = executing(ChunkingSpec(n_action_steps=4, mode="rtc", delay=PLAYED), played=(1, 3, 2))
        told = []
        for step in range(12):
            if step == executor.next_inference_step:
                found = executor.committed(step, n_dims=1)
                assert found is not None
                told.append(found.n_frozen)
                executor.submit(step, chunk(step, 9), seconds=0.0)

        assert told == [0, 1, 3]

    @pytest.mark.parametrize("mode", [mode for mode in EXECUTIONS if mode not in COMMITTING])
    def test_no_other_mode_tells(self, mode: Mode) -> None:
        executor = executing(ChunkingSpec(n_action_steps=2, mode=mode))
        executor.submit(0, chunk(0, 5), seconds=0.0)

        assert executor.committed(2, n_dims=1) is None

    @pytest.mark.parametrize("mode", ["wait", *COMMITTING])
    def test_a_mode_in_which_nothing_is_late_takes_no_stale_chunks(self, mode: Mode) -> None:
        with pytest.raises(RecipeError, match=rf"delay_alignment is stale, expected skip with .*{mode}"):
            ChunkingSpec(n_action_steps=2, mode=mode, delay_alignment="stale")


@pytest.mark.parametrize("mode", EXECUTIONS)
@pytest.mark.parametrize("size", [4, 7, 24])
def test_any_delays_give_one_action_or_a_hold_per_step_and_no_action_before_it_arrived(
    mode: Mode, size: int
) -> None:
    for seed in range(20):
        random = np.random.default_rng(seed)
        played = tuple(int(d) for d in random.integers(0, 7, 40))
        spec = ChunkingSpec(n_action_steps=int(random.integers(1, 5)), mode=mode, delay=PLAYED)
        executor = executing(spec, played=played)
        inferred: list[int] = []
        for step in range(40):
            if step == executor.next_inference_step:
                executor.submit(step, chunk(step, size), seconds=0.0)
                inferred.append(step)
            found = executor.action(step)
            if found is None:
                continue
            index = inferred.index(found.inferred_at_step)
            assert step >= found.inferred_at_step + played[index]
            # One inference at a time.
            assert all(b - a >= d for a, b, d in zip(inferred, inferred[1:], played, strict=False))
