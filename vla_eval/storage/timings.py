"""Read `timings.jsonl`: wall-clock seconds per episode; what is not there is not known, never zero."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from vla_eval.errors import RunFolderError
from vla_eval.records import EpisodeKey, EpisodeRecord, EpisodeTiming
from vla_eval.storage.durable import read_lines
from vla_eval.storage.episodes_file import is_json
from vla_eval.storage.folders import TIMINGS_FILE
from vla_eval.strict.json_text import Source, as_dataclass, read_json


@dataclass(frozen=True, slots=True, kw_only=True)
class Latency:
    """Median and maximum of the episodes' mean seconds per inference; median seconds of whole episodes."""

    n_episodes: int
    median_seconds: float
    slowest_seconds: float
    episode_seconds: float


def read_timings(folder: Path) -> dict[EpisodeKey, EpisodeTiming]:
    """Return the timing of each episode of a run folder, the last one where it was run again."""
    path = folder / TIMINGS_FILE
    found: dict[EpisodeKey, EpisodeTiming] = {}
    for number, line in enumerate(read_lines(path).split(b"\n"), start=1):
        if line and is_json(line):  # else torn: the episode has a result and no timing
            source = _source(f"{path}:{number}")
            timing = as_dataclass(EpisodeTiming, read_json(line, source), source)
            found[timing.key] = timing
    return found


def _source(where: str) -> Source:
    remedy = "The file was changed by something else. No result depends on it: remove the line, or the file."
    return Source(where=where, what="the timing of an episode", remedy=remedy, error=RunFolderError)


def measure_latency(
    records: Iterable[EpisodeRecord], timings: Mapping[EpisodeKey, EpisodeTiming]
) -> Latency | None:
    """Return how long the inferences of some episodes with results took; None if no timing is known."""
    known = [(record, timings[record.key]) for record in records if record.key in timings]
    each = [timing.inference_seconds / record.n_inferences for record, timing in known if record.n_inferences]
    if not each:
        return None
    return Latency(
        n_episodes=len(each),
        median_seconds=median(each),
        slowest_seconds=max(each),
        episode_seconds=median(timing.total_seconds for _, timing in known),
    )
