"""What a record says of delays, held steps and motion has to go together, too."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from tests.storage.test_strict_records import changed, make, refused
from vla_eval.motion import Motion

MOTION = dict.fromkeys(field.name for field in fields(Motion))
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "more held steps than steps": ({"n_held_steps": 61}, "n_held_steps ≤ n_steps"),
    "an age beyond the episode": ({"mean_age_steps": 61.0}, "mean_age_steps ≤ n_steps"),
    "another number of delays": ({"delay_steps": [1, 2]}, "one delay per inference"),
    "a negative delay": ({"delay_steps": [-1]}, "greater than or equal to 0"),
    "a negative jump": ({"motion": MOTION | {"border_jump_m": -0.1}}, "border_jump_m -0.1"),
    "a motion of other fields": ({"motion": {"smooth": True}}, "no field .motion.border_jump_m."),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG.keys())
def test_what_cannot_be_true_is_refused_with_its_line(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    refused(make(tmp_path / "r", changed(seed=1), changed(**changes)), rf"episodes\.jsonl:2: .*{message}")
