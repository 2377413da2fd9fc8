"""Chunk execution, with actions that carry their own origin: 100 * inference step + row."""

import math

import numpy as np
import pytest

from vla_eval.chunking import ChunkExecutor, ChunkingSpec
from vla_eval.core import ActionChunk
from vla_eval.errors import RecipeError, SpecMismatchError


def chunk(step: int, size: int) -> ActionChunk:
    return ActionChunk(actions=np.array([[100 * step + row] for row in range(size)], dtype=np.float32))


def executed(spec: ChunkingSpec, *, size: int, n_steps: int) -> list[float | None]:
    executor = ChunkExecutor(spec)
    actions: list[float | None] = []
    for step in range(n_steps):
        if step == executor.next_inference_step:
            executor.submit(step, chunk(step, size))
        action = executor.action(step)
        actions.append(None if action is None else float(action[0]))
    return actions


def test_only_the_first_n_action_steps_of_a_chunk_are_executed() -> None:
    spec = ChunkingSpec(n_action_steps=2)

    # Chunks of 4 at steps 0, 2, 4; of each, rows 0 and 1.
    assert executed(spec, size=4, n_steps=6) == [0, 1, 200, 201, 400, 401]


def test_a_whole_chunk_is_executed_open_loop() -> None:
    assert executed(ChunkingSpec(n_action_steps=3), size=3, n_steps=7) == [0, 1, 2, 300, 301, 302, 600]


def test_inferences_come_every_n_action_steps() -> None:
    executor = ChunkExecutor(ChunkingSpec(n_action_steps=3))
    inferred_at = []
    for step in range(8):
        if step == executor.next_inference_step:
            inferred_at.append(step)
            executor.submit(step, chunk(step, 3))

    assert inferred_at == [0, 3, 6]


def test_a_delay_with_skip_drops_what_is_past() -> None:
    spec = ChunkingSpec(n_action_steps=2, delay_steps=1, delay_alignment="skip")

    # Nothing has arrived at step 0. The chunk of step 0 (rows for steps 0, 1, 2) is usable from step 1:
    # rows 1, 2. The chunk of step 2 is usable from step 3: rows 1, 2 again.
    assert executed(spec, size=3, n_steps=5) == [None, 1, 2, 201, 202]


def test_a_delay_with_stale_executes_the_whole_chunk_late() -> None:
    spec = ChunkingSpec(n_action_steps=2, delay_steps=1, delay_alignment="stale")

    assert executed(spec, size=2, n_steps=5) == [None, 0, 1, 200, 201]


def test_a_delay_longer_than_the_interval_keeps_several_chunks_on_the_way() -> None:
    spec = ChunkingSpec(n_action_steps=1, delay_steps=3)

    # At step s >= 3 the newest chunk that has arrived is that of step s - 3, row 3.
    assert executed(spec, size=4, n_steps=6) == [None, None, None, 3, 103, 203]


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
    spec = ChunkingSpec(n_action_steps=2, delay_steps=1, mode="temporal_ensemble", ensemble_decay=0.0)

    # Inferences at 0 and 2, chunks of 4. Step 1, 2: chunk 0 rows 1, 2. Step 3: chunk 0 row 3 and chunk 2
    # row 1, equal weights: (3 + 201) / 2.
    assert executed(spec, size=4, n_steps=4) == [None, 1, 2, 102]


def test_executed_actions_are_no_views_of_the_policy_s_array() -> None:
    given = chunk(0, 2)
    executor = ChunkExecutor(ChunkingSpec(n_action_steps=2))
    executor.submit(0, given)
    given.actions[:] = -1  # a policy that reuses its buffer

    action = executor.action(0)
    assert action is not None
    action[:] = -2
    again = executor.action(0)

    assert again is not None
    assert again[0] == 0


def test_the_first_inference_may_be_late_and_all_others_follow_it_by_n_action_steps() -> None:
    spec = ChunkingSpec(n_action_steps=3, first_inference_step=2)

    # Nothing to execute at steps 0 and 1; chunks at steps 2 and 5.
    assert executed(spec, size=3, n_steps=7) == [None, None, 200, 201, 202, 500, 501]
    assert ChunkExecutor(spec).next_inference_step == 2


def test_a_first_inference_that_repeats_an_earlier_rhythm_is_refused() -> None:
    ChunkingSpec(n_action_steps=3, first_inference_step=2)
    with pytest.raises(RecipeError, match=r"first_inference_step is 3, expected less than .* which is 3"):
        ChunkingSpec(n_action_steps=3, first_inference_step=3)


@pytest.mark.parametrize(
    ("field", "value"),
    [("n_action_steps", 0), ("delay_steps", -1), ("ensemble_decay", -0.1), ("first_inference_step", -1)],
)
def test_values_out_of_range_are_refused(field: str, value: float) -> None:
    with pytest.raises(RecipeError, match=rf"chunking\.{field} is {value}, expected a number ≥"):
        ChunkingSpec(**{"n_action_steps": 1, field: value})


def test_a_chunk_too_short_for_the_delay_is_refused() -> None:
    spec = ChunkingSpec(n_action_steps=4, delay_steps=2)

    spec.check_chunk_size(6, policy="p")
    with pytest.raises(SpecMismatchError, match=r"'p' predicts chunks of 5 .* needs 6"):
        spec.check_chunk_size(5, policy="p")
