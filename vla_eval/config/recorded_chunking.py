"""The section `chunking` as `run.json` has it: where it can be, as versions without its later fields did."""

from collections.abc import Mapping
from typing import Any  # plain data

from vla_eval.chunking import ChunkingSettings
from vla_eval.latency import VaryingDelay
from vla_eval.strict.decoding import decode

OLD_DELAY = "delay_steps"
"""A delay that is one number."""


def recorded_chunking(chunking: ChunkingSettings, data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the section, whose plain data are given, for `run.json`: what asks for nothing is left out."""
    recorded = dict(data)
    if chunking.first_inference_step == 0:
        del recorded["first_inference_step"]
    if not chunking.execution.is_guided:
        del recorded["rtc"]
    if isinstance(chunking.delay, int):
        recorded[OLD_DELAY] = recorded.pop("delay")
    elif isinstance(chunking.delay, VaryingDelay):
        given = {"steps": chunking.delay.steps, "p": chunking.delay.p, "trace": chunking.delay.trace}
        recorded["delay"] = {name: value for name, value in given.items() if value}
    return recorded


def read_chunking(recorded: Mapping[str, Any], *, where: str) -> ChunkingSettings:
    """Read it back; a `RecipeError` if it is of a later version."""
    data = dict(recorded)
    if OLD_DELAY in data:
        data["delay"] = data.pop(OLD_DELAY)
    return decode(ChunkingSettings, data, where=where)
