"""Inferences per second of a checkpoint's network, as it is and compiled, by episodes in a pass."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped

import torch
from torch import Tensor

from vla_eval.checkpoints.loading import LoadOptions, load_checkpoint
from vla_eval.checkpoints.policy_types import history, noise_shape
from vla_eval.checkpoints.verify import random_batch
from vla_eval.errors import SpecMismatchError
from vla_eval.models.episodes.memory import remembers_in_rows
from vla_eval.policies.lerobot.compiling import begin_pass, compile_network

N_TIMED = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Compiled:
    """Of the compiled network; `difference` is the largest |Δ| of an action, `scale` the largest action."""

    per_second: float
    first_seconds: float  # of the first pass, in which it is compiled
    difference: float
    scale: float


@dataclass(frozen=True, slots=True, kw_only=True)
class InferenceRate:
    """Inferences per second, the mean of `N_TIMED` passes after the first."""

    per_second: float
    compiled: Compiled | None
    why_not: str = ""  # it was not compiled


@torch.no_grad()
def inference_rates(folder: Path, device: str, batches: Sequence[int]) -> dict[int, InferenceRate]:
    """Return the rates by the number of episodes in one pass."""
    loaded = load_checkpoint(folder, LoadOptions(device=device))
    why_not = ""
    try:
        compile_network(loaded, policy=folder.name)
    except SpecMismatchError as exc:
        why_not = str(exc)
    one = random_batch(loaded.config, history(loaded.config), torch.Generator().manual_seed(0))
    return {n: _rate(loaded, one, n, why_not) for n in batches}


def _rate(loaded: Any, one: dict[str, Any], n: int, why_not: str) -> InferenceRate:
    batch = {key: x.repeat_interleave(n, 0) if isinstance(x, Tensor) else x * n for key, x in one.items()}
    shape = noise_shape(loaded.config)
    draws = torch.Generator().manual_seed(0)
    noise = None if shape is None else torch.randn((n, *shape), generator=draws).to(loaded.config.device)

    def infer() -> Tensor:
        torch.manual_seed(0)
        begin_pass(loaded.config.device)
        extra = {} if noise is None else {"noise": noise}
        if remembers_in_rows(loaded.policy):
            extra["memory"] = loaded.policy.begin_memory(n)
        chunk = loaded.policy.predict_action_chunk(loaded.preprocessor(dict(batch)), **extra)
        actions: Tensor = loaded.postprocessor(chunk)  # on the CPU, so that the device has finished
        return actions.clone()

    with torch.compiler.set_stance("force_eager"):
        expected, _, seconds = _timed(infer)
    rate = n / seconds
    if why_not:
        return InferenceRate(per_second=rate, compiled=None, why_not=why_not)
    found, first_seconds, seconds = _timed(infer)
    difference, scale = (found - expected).abs().max(), expected.abs().max()
    compiled = Compiled(
        per_second=n / seconds, first_seconds=first_seconds, difference=float(difference), scale=float(scale)
    )
    return InferenceRate(per_second=rate, compiled=compiled)


def _timed(infer: Callable[[], Tensor]) -> tuple[Tensor, float, float]:
    """Return the actions, the seconds of the first pass, and the mean of the next ones."""
    begun = time.perf_counter()
    actions = infer()
    first = time.perf_counter() - begun
    infer()  # on a GPU, the second pass records the graphs
    begun = time.perf_counter()
    for _ in range(N_TIMED):
        infer()
    return actions, first, (time.perf_counter() - begun) / N_TIMED
