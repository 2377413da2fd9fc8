"""Read `episodes.jsonl`, one record per line, and repair its end after its writer was killed."""

import json
import logging
import os
from pathlib import Path

from vla_eval.errors import RunFolderError
from vla_eval.records import EpisodeKey, EpisodeRecord
from vla_eval.storage.durable import read_lines, whole_lines
from vla_eval.storage.planned import PlannedEpisodes

logger = logging.getLogger(__name__)

MAX_NAMED = 5


def parse_records(data: bytes, path: Path, planned: PlannedEpisodes) -> dict[EpisodeKey, EpisodeRecord]:
    """Return the record that counts of each key, in the order in which the keys first appear."""
    records: dict[EpisodeKey, EpisodeRecord] = {}
    strangers: list[str] = []
    for line, where in whole_lines(data, path):
        try:
            text = line.decode("utf-8")
        except UnicodeDecodeError as exc:
            raise RunFolderError(
                f"{where}: expected an episode record in UTF-8, found {line[:80]!r}. The file was changed by "
                f"something else; restore it or start a new run folder."
            ) from exc
        record = EpisodeRecord.from_json(text, where=where)
        objection = planned.objection(record)
        if objection is not None:
            strangers.append(f"  line {where.rpartition(':')[2]}: {shown_key(record.key)}: {objection}")
        known = records.get(record.key)
        if known is None or known.outcome == "error":
            records[record.key] = record
        elif record.outcome != "error":
            raise RunFolderError(
                f"{where}: a second result of {shown_key(record.key)}. The file was changed by "
                f"something else; remove one of the two lines or start a new run folder."
            )
    if strangers:
        raise _not_planned(strangers, path)
    return records


def _not_planned(strangers: list[str], path: Path) -> RunFolderError:
    more = [f"  … and {len(strangers) - MAX_NAMED} more"] if len(strangers) > MAX_NAMED else []
    listed = "\n".join((*strangers[:MAX_NAMED], *more))
    return RunFolderError(
        f"{path}: expected the episodes that this run's configuration (run.json) plans, found "
        f"{len(strangers)} that it does not:\n{listed}\nThey are from another run, or a file was changed: "
        f"move these lines to the folder of their own run, or start a new run folder."
    )


def repair_records(path: Path, planned: PlannedEpisodes) -> dict[EpisodeKey, EpisodeRecord]:
    """Read the records, if there are any; make a last line that was torn by a kill whole, or cut it off."""
    data = read_lines(path)
    tail = data[data.rfind(b"\n") + 1 :]
    if tail:
        is_whole = is_json(tail)
        if is_whole:
            logger.warning("%s: the last line lacked its end; it is complete now", path)
            data += b"\n"
        else:
            logger.warning("%s: an incomplete last line of %d bytes was cut off", path, len(tail))
            data = data[: -len(tail)]
    records = parse_records(data, path, planned)
    if tail:  # only now: a file that is refused stays as it was found
        with open(path, "r+b") as file:
            if is_whole:
                file.seek(len(data) - 1)
                file.write(b"\n")
                file.flush()
            else:
                file.truncate(len(data))
            os.fsync(file.fileno())
    return records


def is_json(tail: bytes) -> bool:
    """Whether a line is whole but for its end: no beginning of a JSON object is itself JSON."""
    try:
        json.loads(tail)
    except (ValueError, RecursionError):
        return False
    return True


def shown_key(key: EpisodeKey) -> str:
    """Return an episode's identity for a message."""
    return f"{key.policy} on {key.task} (n_action_steps {key.n_action_steps}, run {key.run}, seed {key.seed})"
