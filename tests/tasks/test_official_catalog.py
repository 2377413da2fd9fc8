"""The rows of the official tasks, which need no official package."""

from collections import Counter

import pytest

from vla_eval.config.prompts import instruction_for
from vla_eval.errors import UnknownNameError
from vla_eval.tasks.catalog import SUITES, TASKS, task_spec


def test_splits_and_memory_types_have_the_documented_sizes() -> None:
    rows = SUITES["mikasa_vla_90"].values()
    # The official documentation, page "benchmarking" (mikasarobo.github.io, tag v1.0.0).
    assert Counter(row.split for row in rows) == {"short": 38, "medium": 30, "long": 22}
    assert Counter(row.memory for row in rows) == {
        "object": 18,
        "spatial": 14,
        "capacity": 12,
        "temporal": 12,
        "negative": 9,
        "sequential": 6,
        "procedural": 6,
        "prospective": 5,
        "tracking": 4,
        "checklist": 4,
    }


def test_an_official_task_has_its_own_sentence_in_any_prompt_set() -> None:
    row = task_spec("mikasa_vla/TimedTransferHard-Long-VLA-v0")
    assert "exactly on step 1000 of that count" in instruction_for(row, "paper")
    assert instruction_for(row, "paraphrased") == instruction_for(row, "paper")


def test_an_original_official_task_has_the_sentence_and_the_horizon_of_ours() -> None:
    ours, theirs = TASKS["RememberColor3-v0"], task_spec("mikasa_official/RememberColor3-v0")
    assert instruction_for(theirs) == instruction_for(ours)
    assert theirs.horizon_steps == ours.horizon_steps


def test_ids_of_the_suites_are_not_mixed_up() -> None:
    assert not set(TASKS) & set(SUITES["mikasa_vla_90"])
    own = {*SUITES["paper"], *SUITES["objects"]}
    assert own == set(TASKS) and len(SUITES["paper"]) == 32
    with pytest.raises(UnknownNameError, match="Did you mean 'mikasa_vla/RememberColor3-VLA-v0'"):
        task_spec("mikasa_vla/RememberColour3-VLA-v0")
