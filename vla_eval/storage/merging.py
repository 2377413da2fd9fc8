"""Put the shards of a run together as the run folder that one run would have left, checked before."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.errors import MergeError
from vla_eval.records import EpisodeKey, EpisodeRecord
from vla_eval.storage.capture_files import EPISODE_FILES
from vla_eval.storage.drafts import link_file, whole_folder
from vla_eval.storage.durable import replace_file
from vla_eval.storage.episodes_file import shown_key
from vla_eval.storage.folders import EPISODES_FILE, TIMINGS_FILE
from vla_eval.storage.run_file import RunFile
from vla_eval.storage.run_folder import StoredRun, read_run
from vla_eval.storage.shard_parts import ShardPart, as_part, merge_descriptions, missing_shards
from vla_eval.storage.timings import read_timings


@dataclass(frozen=True, slots=True, kw_only=True)
class MergedRun:
    """Description and sessions of all shards, their records in the plan's order, and what is missing."""

    run_file: RunFile
    runs: tuple[StoredRun, ...]
    records: tuple[EpisodeRecord, ...]
    missing: tuple[str, ...]

    @property
    def n_errors(self) -> int:
        """How many episodes ended in an error."""
        return sum(record.outcome == "error" for record in self.records)


def merge_runs(folders: Sequence[Path], *, allow_environment_change: bool = False) -> MergedRun:
    """Read shards of one plan, compare them and put them together; nothing is written."""
    runs = [read_run(folder) for folder in folders]
    parts = [as_part(run.path, RunFile(description=run.description, sessions=run.sessions)) for run in runs]
    run_file = merge_descriptions(parts, allow_environment_change=allow_environment_change)
    rank_of = {group: rank for rank, group in enumerate(parts[0].shard.groups)}
    records = sorted(
        (record for run in runs for record in run.records),
        key=lambda record: (rank_of[record.key[:3]], *record.key[3:]),
    )
    missing = [*missing_shards(parts)]
    for part, run in zip(parts, runs, strict=True):
        missing += _missing_episodes(part, {record.key for record in run.records})
    return MergedRun(run_file=run_file, runs=tuple(runs), records=tuple(records), missing=tuple(missing))


def write_merged(merged: MergedRun, out: Path) -> None:
    """Write the run folder, captures linked or copied; after an error nothing is left."""
    timings = {key: one for run in merged.runs for key, one in read_timings(run.path).items()}
    kept = [timings[record.key].to_json() for record in merged.records if record.key in timings]
    with whole_folder(out, error=MergeError) as draft:
        draft.mkdir()
        replace_file(draft / TIMINGS_FILE, "".join(f"{line}\n" for line in kept))
        replace_file(draft / EPISODES_FILE, "".join(f"{one.to_json()}\n" for one in merged.records))
        merged.run_file.save(draft)
        for run in merged.runs:
            for place, record in itertools.product(EPISODE_FILES, run.records):
                if place(run.path, record).is_file():
                    link_file(place(run.path, record), place(draft, record))


def _missing_episodes(part: ShardPart, there: set[EpisodeKey]) -> Iterator[str]:
    absent = [key for key in _planned(part) if key not in there]
    if absent:
        yield (
            f"{part.path} (shard {part.shard}): {len(absent)} of {len(absent) + len(there)} episodes were "
            f"not run, such as {shown_key(absent[0])}. To resume: {part.run_file.sessions[-1].command}"
        )


def _planned(part: ShardPart) -> Iterator[EpisodeKey]:
    """Return every episode of a shard, by its description."""
    planned = part.run_file.planned(part.path)
    config, shard = planned.config, part.shard
    if config.episodes is None or config.seed_start is None or config.runs is None:
        raise MergeError(
            f"{part.path}: expected episodes, seed_start and runs in the configuration of its run.json, "
            f"found no such field. The file was changed by another program; restore it."
        )
    for group in shard.groups:
        for run in range(config.n_runs(group[1], group[0]) or config.runs):
            for index in shard.indices(config.episodes):
                yield EpisodeKey(*group, run, config.seed_start + index)
