"""The tables of docs/hardware.md from what rehearsals measured. Standard library only."""

from collections.abc import Iterator, Mapping
from typing import Any  # results as JSON holds them

STAGES = ("write", "load", "act")


def rehearsal_tables(results: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return lines of Markdown.

    Args:
        results: by part: what `Rehearsed.data` returns, or of a conversion `converted`, `bytes`, `seconds`,
            `peak_rss_bytes` and `limit_bytes`.
    """
    rehearsed = [x for x in results.values() if "recipe" in x]
    converted = [x for x in results.values() if "converted" in x]
    return [*_rehearsed(rehearsed), *([""] if rehearsed and converted else []), *_converted(converted)]


def _rehearsed(results: list[Mapping[str, Any]]) -> Iterator[str]:
    if not results:
        return
    yield (
        "| recipe | precision | parameters | trained | on disk | write | load | first, second inference "
        "| memory: before, writing, loading, acting | estimated: writing, loading, acting | limit |"
    )
    yield "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|"
    for found in results:
        seconds, peaks, estimated = found["seconds"], found["peak_rss_bytes"], found["estimated"]
        expected = [estimated["peak_rss_bytes"].get(stage) for stage in STAGES]
        cells = [
            f"`{found['recipe']}`",
            found["dtype"],
            _beside(found["parameters"], estimated["parameters"]),
            _beside(found["trained"], estimated["trained"]),
            f"{_gb(found['bytes'])} GB",
            f"{seconds['write']:.0f} s",
            f"{seconds['load']:.0f} s",
            f"{seconds['first_inference']:.0f} s, {seconds['second_inference']:.0f} s",
            f"{', '.join(map(_gb, [found['before_bytes'], *(peaks[x] for x in STAGES)]))} GB",
            f"{', '.join('—' if x is None else _gb(x) for x in expected)} GB",
            f"{_gb(found['limit_bytes'])} GB{'' if found['is_within_limit'] else ', **exceeded**'}",
        ]
        yield f"| {' | '.join(cells)} |"


def _converted(results: list[Mapping[str, Any]]) -> Iterator[str]:
    if not results:
        return
    yield "| original | result | peak memory of the conversion | limit | seconds |"
    yield "|---|--:|--:|--:|--:|"
    for found in results:
        is_above = found["peak_rss_bytes"] > found["limit_bytes"]
        cells = [
            found["converted"],
            f"{_gb(found['bytes'])} GB",
            f"{_gb(found['peak_rss_bytes'])} GB",
            f"{_gb(found['limit_bytes'])} GB{', **exceeded**' if is_above else ''}",
            f"{found['seconds']:.0f}",
        ]
        yield f"| {' | '.join(cells)} |"


def _beside(measured: int, estimated: int) -> str:
    """Return a number, with its estimate where that is another one."""
    return f"{measured:,}" if measured == estimated else f"{measured:,} (estimated {estimated:,})"


def _gb(n_bytes: float) -> str:
    return f"{n_bytes / 1e9:.{2 if n_bytes < 10e9 else 1}f}"
