"""Read `episodes.jsonl`, and repair its end after its writer was killed.

One line is one `EpisodeRecord`. What follows the last newline is no line yet.
"""

import json
import logging
import os
from pathlib import Path

from vla_eval.errors import RunFolderError
from vla_eval.records import EpisodeKey, EpisodeRecord

logger = logging.getLogger(__name__)


def parse_records(data: bytes, path: Path) -> dict[EpisodeKey, EpisodeRecord]:
    """Return the record that counts of each key, in the order in which the keys first appear.

    Args:
        data: whole lines.
        path: where they are from, for messages.

    Raises:
        RunFolderError: a line is no record, or a key has two results.
    """
    records: dict[EpisodeKey, EpisodeRecord] = {}
    for number, line in enumerate(data.split(b"\n")[:-1], start=1):
        record = _parse_record(line, f"{path}:{number}")
        known = records.get(record.key)
        if known is None or known.outcome == "error":
            records[record.key] = record
        elif record.outcome != "error":
            raise RunFolderError(
                f"{path}:{number}: a second result of {shown_key(record.key)}. The file was changed by "
                f"something else; remove one of the two lines or start a new run folder."
            )
    return records


def _parse_record(line: bytes, where: str) -> EpisodeRecord:
    try:
        text = line.decode("utf-8")
    except UnicodeDecodeError as exc:
        raise RunFolderError(
            f"{where}: expected an episode record in UTF-8, found {line[:80]!r}. The file was changed by "
            f"something else; restore it or start a new run folder."
        ) from exc
    return EpisodeRecord.from_json(text, where=where)


def repair_records(path: Path) -> dict[EpisodeKey, EpisodeRecord]:
    """Read the records; make a last line that was torn by a kill whole, or cut it off.

    Args:
        path: the file; nothing is done if it is not there.

    Raises:
        RunFolderError: a line is damaged; the file is left as it is.
    """
    if not path.exists():
        return {}
    data = path.read_bytes()
    tail = data[data.rfind(b"\n") + 1 :]
    if tail:
        is_whole = _is_json(tail)
        if is_whole:
            logger.warning("%s: the last line lacked its end; it is complete now", path)
            data += b"\n"
        else:
            logger.warning("%s: an incomplete last line of %d bytes was cut off", path, len(tail))
            data = data[: -len(tail)]
    records = parse_records(data, path)
    if tail:  # only now: a file that is refused stays as it was found
        _set_end(path, size=len(data), complete=is_whole)
    return records


def _is_json(tail: bytes) -> bool:
    """Whether a line is whole but for its end: no beginning of a JSON object is itself JSON."""
    try:
        json.loads(tail)
    except ValueError:
        return False
    return True


def _set_end(path: Path, *, size: int, complete: bool) -> None:
    with open(path, "r+b") as file:
        if complete:
            file.seek(size - 1)
            file.write(b"\n")
            file.flush()
        else:
            file.truncate(size)
        os.fsync(file.fileno())


def cut_tail(path: Path) -> None:
    """Cut off an incomplete last line of a file that no result depends on."""
    if path.exists():
        data = path.read_bytes()
        end = data.rfind(b"\n") + 1
        if end != len(data):
            os.truncate(path, end)


def shown_key(key: EpisodeKey) -> str:
    """Return an episode's identity for a message."""
    return f"{key.policy} on {key.task} (n_action_steps {key.n_action_steps}, run {key.run}, seed {key.seed})"
