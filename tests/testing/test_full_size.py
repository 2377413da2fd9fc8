"""The published sizes, rehearsed with random weights: minutes and up to 20 GB of disk and memory each.

`make rehearse` runs them; its table is docs/hardware.md. The numbers of parameters are those that public code
states for the published files.
"""

import functools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.testing.published_originals import write_octo, write_openvla, write_spatialvla
from vla_eval.policies.checkpoint import WEIGHTS_FILE
from vla_eval.testing.rehearsal import RehearsalOptions, rehearse
from vla_eval.testing.rehearsed import limit_bytes

pytestmark = pytest.mark.full_size
GEMMA_EMBEDDINGS = 257_152 * 2_048  # lerobot's π0 family has them twice, a published file once
PALIGEMMA = 2_923_466_480 - (257_216 - 257_152) * 2_048  # of the published one, whose embeddings are padded
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
        ("pi0_fast", PALIGEMMA + GEMMA_EMBEDDINGS),
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


GRIPPER = ("--gripper", "unit_open")
CONVERSIONS: tuple[tuple[str, Callable[[Path], None], tuple[str, ...]], ...] = (
    *(
        (f"octo-{size}", functools.partial(write_octo, size), ("convert-octo", "--size", size, *GRIPPER))
        for size in ("small", "base")
    ),
    ("spatialvla", write_spatialvla, ("convert-spatialvla",)),
    ("openvla", write_openvla, ("convert-openvla", "--image-aug", "no", *GRIPPER)),
)
MEASURED = """
import sys
from vla_eval.cli.main import main
from vla_eval.testing.process_memory import peak_rss_bytes
assert main(["checkpoint", *sys.argv[1:]]) == 0
print(peak_rss_bytes())
"""


@pytest.mark.parametrize(("name", "write", "arguments"), CONVERSIONS)
def test_a_published_checkpoint_of_full_size_is_converted_within_its_memory(
    name: str, write: Callable[[Path], None], arguments: tuple[str, ...], tmp_path: Path
) -> None:
    """It has the original's names and shapes. The peak is that of a process which only converts."""
    source, out = tmp_path / "published", tmp_path / "ours"
    source.mkdir()
    write(source)
    tokenizer = ("--tokenizer", "bytes") if name.startswith("octo") else ()
    action, *flags = arguments
    command = [sys.executable, "-c", MEASURED, action, str(source), "--out", str(out), *flags, *tokenizer]
    started = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True)
    seconds = time.perf_counter() - started
    assert done.returncode == 0, done.stderr
    n_bytes = (out / WEIGHTS_FILE).stat().st_size
    limit, peak = limit_bytes(n_bytes), int(done.stdout.splitlines()[-1])
    if TABLE in os.environ:
        found = {"converted": name, "bytes": n_bytes, "seconds": seconds, "peak_rss_bytes": peak}
        with Path(os.environ[TABLE]).open("a", encoding="utf-8") as file:
            file.write(f"{json.dumps({**found, 'limit_bytes': limit})}\n")
    assert peak <= limit
