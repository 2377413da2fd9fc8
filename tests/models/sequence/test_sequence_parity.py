"""The sequence models compute what their authors' code computes, with the same tiny random weights.

`tests/golden/sequence/io.safetensors` was made by running the modules of
https://github.com/CognitiveAISystems/RATE on a CPU in float32: RATE/RATE_model.py of commit 5aa88f0 as RATE
(memory length 7, one memory token, a valve of two heads), as GTrXL and as DT; of commit 8b80e4e
offline_rl_baselines/ELMUR/model.py (three slots of which all had been written) and the blocks of
offline_rl_baselines/DMamba.py (`mamba-min` with the norm of `mamba`). Encoders and heads were identities, so
that tokens go in and answers come out. Segments have three steps; width 8, two layers, two heads, no dropout.
With several memory tokens RATE's own code lets those at a segment's beginning read later ones by a score of
other distances (see `sinusoids`); with one, nobody reads a later one.
"""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.models.golden_values import GoldenValues
from tests.models.sequence.original_weights import ours
from vla_eval.models.cores.core import Core
from vla_eval.models.cores.cores import make_core

GOLDEN = Path(__file__).parents[2] / "golden" / "sequence" / "io.safetensors"
STEPS = 3
SIZES: dict[str, Any] = {"width": 8, "layers": 2, "heads": 2, "context_steps": STEPS, "dropout": 0.0}
OPTIONS: dict[str, dict[str, Any]] = {
    "rate": {"head_width": 6, "cached_tokens": 7, "memory_tokens": 1, "valve_heads": 2},
    "gtrxl": {"head_width": 6, "inner_width": 5, "cached_tokens": 7},
    "decision_transformer": {"head_width": 6, "inner_width": 5},
    "elmur": {"slots": 3, "blend": 0.4, "experts": 3, "inner_width": 5, "longest": 6},
    "decision_mamba": {},
}


@pytest.fixture(scope="module")
def io() -> GoldenValues:
    return GoldenValues(GOLDEN)


def original(io: GoldenValues, name: str, *, tokens_per_step: int = 1) -> Core:
    core = make_core(name, **SIZES, tokens_per_step=tokens_per_step, given=OPTIONS[name]).eval()
    prefix = f"{name}.weights."
    weights = ours({key.removeprefix(prefix): io[key] for key in io if key.startswith(prefix)})
    if name == "elmur":
        weights["empty_slots"] = io["elmur.slots"]
    core.load_state_dict(weights)
    return core


def answers(core: Core, tokens: Tensor, memory: tuple[Tensor, ...], *, at_once: int) -> tuple[Tensor, Any]:
    parts = []
    with torch.no_grad():
        for piece in tokens.split(at_once, dim=1):
            answer, memory = core(piece, memory)
            parts.append(answer)
    return torch.cat(parts, dim=1), memory


@pytest.mark.parametrize("at_once", [1, 100])
@pytest.mark.parametrize("name", ["rate", "gtrxl", "decision_transformer"])
def test_segments_are_answered_as_by_rates_code(io: GoldenValues, name: str, at_once: int) -> None:
    core, tokens = original(io, name, tokens_per_step=3), io[f"{name}.tokens"]
    found, _ = answers(core, tokens, core.begin(len(tokens)), at_once=at_once)
    of_observations = found.unflatten(1, (-1, 3))[:, :, 1]
    torch.testing.assert_close(of_observations, io[f"{name}.answers"], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("at_once", [1, 100])
def test_slots_are_read_and_written_as_by_elmurs_code(io: GoldenValues, at_once: int) -> None:
    core, tokens = original(io, "elmur"), io["elmur.tokens"]
    room, n_tokens, slots, _, n_segments = core.begin(len(tokens))
    memory = (room, n_tokens, slots, io["elmur.written"], n_segments)
    found, after = answers(core, tokens, memory, at_once=at_once)
    torch.testing.assert_close(found, io["elmur.answers"], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(after[2], io["elmur.slots_after"], atol=1e-5, rtol=1e-5)
    assert torch.equal(after[3], io["elmur.written_after"])


def test_decision_mamba_answers_as_the_authors_blocks(io: GoldenValues) -> None:
    core, tokens = original(io, "decision_mamba"), io["decision_mamba.tokens"]
    found, _ = answers(core, tokens, core.begin(len(tokens)), at_once=1)
    torch.testing.assert_close(found, io["decision_mamba.answers"], atol=1e-5, rtol=1e-5)
    in_training, _ = core.train()(tokens, core.begin(len(tokens)))
    torch.testing.assert_close(in_training, io["decision_mamba.answers"], atol=1e-5, rtol=1e-5)


def test_an_empty_slot_takes_all_of_what_is_written_and_a_full_one_a_share() -> None:
    """arXiv:2510.07151: empty slots first, in order; then the oldest, of which `1 - blend` stays."""
    torch.manual_seed(0)
    options = {**OPTIONS["elmur"], "slots": 2, "blend": 0.0}
    core = make_core("elmur", **SIZES, given=options).eval()
    tokens, memory = torch.randn(1, 5 * STEPS, 8), core.begin(1)
    written = []
    for segment in tokens.split(STEPS, dim=1):
        _, memory = answers(core, segment, memory, at_once=STEPS)
        written.append((memory[2][0, 0].clone(), memory[3][0].tolist()))
    # A segment's number is that of its newest token: 2, 5, 8, ...
    assert [numbers for _, numbers in written] == [[2, -1], [2, 5], [8, 5], [8, 11], [14, 11]]
    assert not torch.equal(written[0][0][0], core.begin(1)[2][0, 0, 0])
    assert torch.equal(written[4][0], written[1][0])  # a share of 0 leaves full slots as they are
