"""The published sizes, rehearsed with random weights: minutes and up to 20 GB of disk and memory each.

`make rehearse` runs them; its table is docs/hardware.md. The numbers of parameters are those that public code
states for the published files.
"""

import json
import os
from pathlib import Path

import pytest

from vla_eval.testing.rehearsal import RehearsalOptions, rehearse

pytestmark = pytest.mark.full_size
GEMMA_EMBEDDINGS = 257_152 * 2_048  # lerobot's π0 family has them twice, a published file once
SMOLVLA, OCTO_SMALL, OCTO_BASE = 450_046_176, 136_670_604, 92_830_092 + 109_628_544
TABLE = "REHEARSAL_TABLE"
"""Environment variable: a file to which each result is appended as a line of JSON."""


@pytest.mark.parametrize(
    ("recipe", "n_parameters"),
    [
        ("octo_small", OCTO_SMALL),
        ("octo_base", OCTO_BASE),
        ("smolvla", SMOLVLA),
        ("pi0", 3_501_372_176 + GEMMA_EMBEDDINGS),
        ("pi05", 3_616_757_520 + GEMMA_EMBEDDINGS),
        ("spatialvla", 4_027_854_731),
        ("openvla_oft", None),
    ],
)
def test_a_policy_of_the_published_size_loads_and_acts_within_its_memory(
    recipe: str, n_parameters: int | None, tmp_path: Path
) -> None:
    found = rehearse(recipe, RehearsalOptions(folder=tmp_path / "rehearsal"))
    if TABLE in os.environ:
        with Path(os.environ[TABLE]).open("a", encoding="utf-8") as file:
            file.write(f"{json.dumps(found.data())}\n")
    if n_parameters is not None:
        assert found.parameters == n_parameters
    assert found.is_within_limit, "\n".join(found.lines())
