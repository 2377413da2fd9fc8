"""Random damage to each file of a dataset: it is read as it is, or refused with a message."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.json_cases import BYTES, VALUES, near
from vla_eval.data.foreign.convert import find_source
from vla_eval.data.frames.decoded_frames import DecodedFramesDataset
from vla_eval.data.opening import open_local_dataset
from vla_eval.data.sharing.card import write_card
from vla_eval.data.sharing.initial_states import read_initial_states
from vla_eval.data.sharing.rrd import EpisodeWish, write_dataset_rrds
from vla_eval.errors import VlaEvalError
from vla_eval.testing.synthetic import write_synthetic_dataset

INFO, STATS = Path("meta/info.json"), Path("meta/stats.json")
EPISODES = Path("meta/episodes/chunk-000/file-000.parquet")
FRAMES, TASKS = Path("data/chunk-000/file-000.parquet"), Path("meta/tasks.parquet")
VIDEO = Path("videos/observation.images.base/chunk-000/file-000.mp4")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of two episodes of 3 and 4 frames."""
    return write_synthetic_dataset(tmp_path_factory.mktemp("fuzz") / "whole", n_episodes=2, n_frames=3)


@pytest.fixture
def root(whole: Path, tmp_path: Path) -> Path:
    """A copy, of which each case damages one file and puts it back."""
    shutil.copytree(whole, tmp_path / "root")
    return tmp_path / "root"


WAYS: dict[str, Callable[[Path], object]] = {
    "view": lambda root: write_dataset_rrds(root, EpisodeWish(most=1), root.parent / "out"),
    "convert": lambda root: [one.read_images() for one in find_source(root).episodes],
    "check-leak": lambda root: read_initial_states(root).read_frames(),
    "finetune": lambda root: DecodedFramesDataset(open_local_dataset(root), storage="ram")[0],
    "card": write_card,
}
"""What verbs do with a dataset, as far as they read it."""


def read_one_way(root: Path, data: st.DataObject) -> None:
    """Read a dataset as one of the verbs does; a refusal with a message is right."""
    try:
        WAYS[data.draw(st.sampled_from(sorted(WAYS)))](root)
    except VlaEvalError as exc:
        assert len(str(exc)) < 3000


def put_back(root: Path, name: Path, content: bytes) -> Iterator[None]:
    before = (root / name).read_bytes()
    (root / name).write_bytes(content)
    try:
        yield
    finally:
        (root / name).write_bytes(before)


def test_an_undamaged_dataset_is_read(root: Path) -> None:
    write_dataset_rrds(root, EpisodeWish(), root.parent / "out")
    assert len([one.read_images() for one in find_source(root).episodes]) == 2
    assert len(read_initial_states(root).read_frames()) == 2


@given(data=st.data())
@pytest.mark.parametrize("name", [INFO, STATS])
def test_json_is_read_or_refused(root: Path, name: Path, data: st.DataObject) -> None:
    written = json.loads((root / name).read_text())
    changed = data.draw(near(written) | VALUES)
    for _ in put_back(root, name, json.dumps(changed).encode(errors="surrogatepass")):
        read_one_way(root, data)


@pytest.mark.sampled(3)
@given(data=st.data())
@pytest.mark.parametrize("name", [INFO, STATS, EPISODES, FRAMES, TASKS, VIDEO])
def test_torn_and_flipped_bytes_are_read_or_refused(root: Path, name: Path, data: st.DataObject) -> None:
    content = bytearray((root / name).read_bytes())
    # FFmpeg's decoders crash on some flipped bits: no Python can catch that (docs/security.md).
    ways = ("cut", "other") if name == VIDEO else ("cut", "other", "flip", "insert")
    match data.draw(st.sampled_from(ways)):
        case "cut":
            content = content[: data.draw(st.integers(0, len(content) - 1))]
        case "flip":
            for _ in range(data.draw(st.integers(1, 4))):
                content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
        case "insert":
            at = data.draw(st.integers(0, len(content)))
            content[at:at] = data.draw(st.binary(min_size=1, max_size=40))
        case "other":
            content = bytearray(data.draw(BYTES))
    for _ in put_back(root, name, bytes(content)):
        read_one_way(root, data)


CELLS = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.text(max_size=5),
    st.booleans(),
    st.none(),
    st.binary(max_size=5),
    st.lists(st.integers(-5, 5), max_size=3),
    st.sampled_from((0, 1, 2, -1, 2**62)),
)


def changed_table(table: Any, data: st.DataObject) -> Any:  # Any: pyarrow.Table
    """Return a table with another column, another cell, other rows, or another order."""
    names = table.column_names
    what = data.draw(st.sampled_from(("column", "cell", "drop", "rows", "twice", "add")))
    name = data.draw(st.sampled_from([one for one in names if not one.startswith("stats/")]))
    at = names.index(name)
    if what == "drop":
        return table.drop([name])
    if what == "rows":
        rows = data.draw(st.lists(st.integers(0, len(table) - 1), max_size=len(table) + 2))
        return table.take(pa.array(rows, pa.int64()))
    if what == "twice":
        return table.append_column(name, table[name])
    values = table[name].to_pylist()
    if what == "cell":
        values[data.draw(st.integers(0, len(values) - 1))] = data.draw(CELLS)
    else:
        values = [data.draw(CELLS)] * len(values)
    try:
        column = pa.array(values)
    except (pa.ArrowException, OverflowError):
        column = pa.array([str(value) for value in values])
    return table.append_column("more", column) if what == "add" else table.set_column(at, name, column)


@pytest.mark.sampled(3)
@given(data=st.data())
@pytest.mark.parametrize("name", [EPISODES, FRAMES, TASKS])
def test_other_columns_and_rows_are_read_or_refused(root: Path, name: Path, data: st.DataObject) -> None:
    before = (root / name).read_bytes()
    try:
        pq.write_table(changed_table(pq.read_table(root / name), data), root / name)
        read_one_way(root, data)
    finally:
        (root / name).write_bytes(before)
