"""Datasets that name files, addresses or programs: what a reader that trusts them would open."""

import base64
import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
from datasets import Features
from datasets.features.features import _FEATURE_TYPES
from fsspec.registry import known_implementations

from vla_eval.data.dataset_folder import digest_files
from vla_eval.data.facts import read_facts
from vla_eval.data.manifest import RECORDING_FILE, write_entry

PIXEL = (  # a PNG of one pixel
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAQAAAC1HAwCAAAAC0lEQVR42mNk+A8AAQUBAScY42YAAAAASUVORK5CYII="
)
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
FRAMES = "data/chunk-000/file-000.parquet"
TASKS = "meta/tasks.parquet"
OPENS_PATHS = sorted(name for name, kind in _FEATURE_TYPES.items() if hasattr(kind, "decode_example"))
"""Types of the installed `datasets` that turn what is stored into something else when it is read."""


class Bait(NamedTuple):
    """What must stay untouched: a file that a program makes, a file that is not to be opened, a server."""

    mark: Path
    secret: Path
    port: int


def addresses(bait: Bait) -> dict[str, str]:
    """Return name -> a path that leads out of the dataset, one for each protocol that fsspec knows."""
    program = "{{ cycler.__init__.__globals__.os.system('touch %s') }}" % bait.mark  # noqa: UP031  # jinja's braces
    generated = {"key": program, "url": "x", "offset": "0", "length": "1", "dimensions": {"i": {"stop": 1}}}
    references = {"version": 1, "refs": {"k": f"base64:{PIXEL}"}, "gen": [generated]}
    data = f"data:application/json;base64,{base64.b64encode(json.dumps(references).encode()).decode()}"
    server = f"127.0.0.1:{bait.port}/x.png"
    known = {name: f"{name}://{server}" for name in known_implementations if name not in ("http", "https")}
    return {
        **known,
        "reference": f"reference://k::{data}",
        "http": f"http://{server}",
        "https": f"https://{server}",
        "path": str(bait.secret),
        "file": f"file://{bait.secret}",
        "up": f"../../../../../../../../..{bait.secret}",
        "data": data,
        "simplecache": f"simplecache::http://{server}",
        "filecache": f"filecache::file://{bait.secret}",
        "zip": f"zip://x.png::http://{server}",
        "zip in zip": f"zip://x::zip://y::file://{bait.secret}",
    }


def add_column(root: Path, table: str, name: str, column: pa.Array, kind: str | None) -> None:
    """Add a column to a table, or replace it, and say that it is of a type of `datasets`."""
    add_columns(root, table, {name: column}, kind)


def add_columns(root: Path, table: str, columns: Mapping[str, pa.Array], kind: str | None) -> None:
    """The same with several at once."""
    path = root / table
    rows = pq.read_table(path)
    rows = rows.drop([name for name in columns if name in rows.column_names])
    plain = Features.from_arrow_schema(rows.schema.remove_metadata()).to_dict()
    for name, column in columns.items():
        rows = rows.append_column(name, column)
    metadata = dict(rows.schema.metadata or {})
    if kind is not None:
        features = {**plain, **{name: {"_type": kind} for name in columns}}
        metadata[b"huggingface"] = json.dumps({"info": {"features": features}}).encode()
    pq.write_table(rows.replace_schema_metadata(metadata), path)


def n_rows(root: Path, table: str) -> int:
    """Return how many rows a table has."""
    return int(pq.read_metadata(root / table).num_rows)


def as_struct(address: str, n: int) -> pa.Array:
    """Return a column of images that are not in it, as `datasets` stores them."""
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    return pa.array([{"bytes": None, "path": address}] * n, type=kind)


def declare(root: Path, name: str, feature: dict[str, Any]) -> None:
    """Add a feature to `info.json`."""
    file = root / "meta/info.json"
    info = json.loads(file.read_text())
    info["features"][name] = feature
    file.write_text(json.dumps(info))


def seal(root: Path) -> None:
    """Let the dataset's own record of its files be right: its author is the same."""
    facts = dataclasses.replace(read_facts(root), files=digest_files(root))
    write_entry(root / RECORDING_FILE, facts)


def hostile_columns(root: Path, address: str, kind: str) -> Iterator[str]:
    """Change a dataset in one way after another, and yield what was changed; undo it before the next."""
    files = [root / name for name in (EPISODES, FRAMES, TASKS, "meta/info.json", RECORDING_FILE)]
    before = {file: file.read_bytes() for file in files}

    def ways() -> Iterator[str]:
        for table in (EPISODES, FRAMES, TASKS):
            n = n_rows(root, table)
            add_column(root, table, "evil", as_struct(address, n), kind)
            yield f"an undeclared column of {table}"
        for column in (as_struct(address, n_rows(root, FRAMES)), pa.array([address] * n_rows(root, FRAMES))):
            add_column(root, FRAMES, "evil", column, kind)
            declare(root, "evil", {"dtype": "image", "shape": [1, 1, 3], "names": None})
            yield f"a declared camera, stored as {column.type}"
        add_column(root, EPISODES, "evil", pa.array([address] * n_rows(root, EPISODES)), kind)
        yield "a text among the episodes"
        add_column(root, TASKS, "task", pa.array([address] * n_rows(root, TASKS)), kind)
        yield "the sentences themselves"

    for way in ways():
        seal(root)
        yield way
        for file, content in before.items():
            file.write_bytes(content)
