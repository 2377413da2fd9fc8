"""Nothing that a dataset names is run, opened or asked for, by whichever verb it is given to."""

import ast
import contextlib
import json
import os
import shutil
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.io_utils import load_episodes

import vla_eval
from tests.data.hostile_datasets import (
    EPISODES,
    FRAMES,
    OPENS_PATHS,
    TASKS,
    Bait,
    add_column,
    add_columns,
    addresses,
    as_struct,
    declare,
    hostile_columns,
    n_rows,
)
from tests.data.second_task import write_second_task
from vla_eval.cli.main import main
from vla_eval.data.opening import open_local_dataset
from vla_eval.errors import DatasetError, ViewingError
from vla_eval.lock.switch import locked
from vla_eval.viz.mp4 import check_mp4, open_mp4

WATCHED = ("open", "os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect")
events: list[tuple[str, str]] = []
is_watching = threading.Event()


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    is_ours = event == "subprocess.Popen" and arguments[0] == "git"  # which version of us this is
    if is_watching.is_set() and event in WATCHED and not is_ours:
        events.append((event, repr(arguments)))


sys.addaudithook(_watch)


@pytest.fixture
def bait(tmp_path: Path) -> Iterator[Bait]:
    """Fail the test if a program ran, a file outside of the dataset was opened, or a server was asked."""
    secret = tmp_path / "elsewhere" / "secret.png"
    secret.parent.mkdir()
    secret.write_bytes(b"\x89PNG\r\n\x1a\n")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.05)
        yield Bait(tmp_path / "mark", secret, server.getsockname()[1])
        is_watching.clear()
        with pytest.raises(TimeoutError):
            server.accept()
    assert not (tmp_path / "mark").exists()
    seen = [
        event for event in events if str(secret) in event[1] or event[0] not in ("open", "socket.connect")
    ]
    events.clear()
    assert not seen


def read_all(root: Path) -> None:
    """Open a dataset and read everything that is in it once; a refusal is right, too."""
    try:
        dataset = open_local_dataset(root)
    except DatasetError:
        return
    _ = dataset[0], dataset.meta.episodes[0], dataset.meta.tasks, dataset.hf_dataset[:]


@pytest.mark.sampled(4)
@pytest.mark.parametrize("kind", OPENS_PATHS)
@pytest.mark.parametrize("scheme", ["reference", "http", "path", "zip"])
def test_no_column_of_any_type_is_opened(recorded: Path, bait: Bait, kind: str, scheme: str) -> None:
    ways = hostile_columns(recorded, addresses(bait)[scheme], kind)
    for _ in ways:
        is_watching.set()
        read_all(recorded)
        is_watching.clear()


def test_no_protocol_that_is_installed_is_asked(recorded: Path, bait: Bait) -> None:
    assert len(addresses(bait)) > 30
    columns = {f"evil {name}": address for name, address in addresses(bait).items()}
    n = n_rows(recorded, EPISODES)
    structs = {name: as_struct(address, n) for name, address in columns.items()}
    add_columns(recorded, EPISODES, structs, "Image")
    is_watching.set()
    with pytest.raises(DatasetError, match=r"'evil .*' of the type"):
        open_local_dataset(recorded)
    is_watching.clear()
    texts = {name: pa.array([address] * n) for name, address in columns.items()}
    add_columns(recorded, EPISODES, texts, "Image")
    is_watching.set()
    row = open_local_dataset(recorded).meta.episodes[0]
    is_watching.clear()
    assert {name: row[name] for name in columns} == columns


@pytest.mark.parametrize("scheme", ["reference", "http", "zip"])
def test_the_lock_alone_lets_nothing_run(
    recorded: Path, bait: Bait, scheme: str, caplog: pytest.LogCaptureFixture
) -> None:
    """With lerobot's own readers, which take the types of columns from the file."""
    add_column(
        recorded, EPISODES, "evil", as_struct(addresses(bait)[scheme], n_rows(recorded, EPISODES)), "Image"
    )
    rows = load_episodes(recorded)
    with locked(), contextlib.suppress(Exception):  # fsspec and jinja make other errors of it, or none
        _ = rows[0]
    assert "refused to" in caplog.text


def verbs(root: Path, other: Path, out: Path) -> dict[str, list[str]]:
    """Return each verb that takes a dataset; those that need a real recording are in `test_record_fake`."""
    return {
        "card": ["dataset", "card", str(root)],
        "mix": ["dataset", "mix", str(root), str(other), "--out", str(out / "mixed")],
        "check-leak": ["dataset", "check-leak", str(root), "--task", "RememberColor3-v0"],
        "convert": ["dataset", "convert", str(root), "--to", "npz", "--out", str(out / "npz")],
        "push": ["dataset", "push", str(root), "a/b"],
        "view": ["view", str(root), "--print"],
        "finetune": [
            *("finetune", "--policy", "act", "--dataset", str(root), "--dry-run", "--allow-unreplayed"),
            *("--out", str(out / "run")),
        ],
    }


@pytest.mark.sampled(4)
@pytest.mark.parametrize("verb", verbs(Path(), Path(), Path()))
@pytest.mark.parametrize("scheme", ["reference", "http"])
def test_no_verb_opens_what_a_column_names(
    recorded: Path,
    bait: Bait,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    verb: str,
    scheme: str,
) -> None:
    other = write_second_task(recorded)
    address = addresses(bait)[scheme]
    for way in hostile_columns(recorded, address, "Image"):
        if "undeclared" not in way and "struct" not in way:
            continue
        is_watching.set()
        code = main(verbs(recorded, other, tmp_path / "out")[verb])
        is_watching.clear()
        said = capsys.readouterr().err
        assert code == 1 and "Traceback" not in said, way
    assert "evil" in said


def test_images_in_a_table_are_read_if_they_are_there(recorded: Path) -> None:
    """An image of one white pixel in each row, as lerobot embeds it: the name beside it is not looked at."""
    import io

    from PIL import Image

    file = io.BytesIO()
    Image.new("RGB", (1, 1), "white").save(file, "PNG")
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    rows = [{"bytes": file.getvalue(), "path": "/etc/passwd"}] * n_rows(recorded, FRAMES)
    add_column(recorded, FRAMES, "observation.images.more", pa.array(rows, type=kind), "Image")
    declare(recorded, "observation.images.more", {"dtype": "image", "shape": [1, 1, 3], "names": None})
    dataset = open_local_dataset(recorded)
    assert dataset[0]["observation.images.more"].tolist() == [[[1.0]], [[1.0]], [[1.0]]]
    assert set(
        dataset.hf_dataset.data.column("observation.images.more").combine_chunks().field("path").to_pylist()
    ) == {None}


@pytest.mark.parametrize("content", [b"%!PS-Adobe-3.0 EPSF-3.0\n", b"", None, b"RIFF....WEBP"])
def test_no_other_program_is_started_for_an_image(recorded: Path, content: bytes | None) -> None:
    """Pillow hands PostScript to Ghostscript."""
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    rows = [{"bytes": content, "path": "a.png"}] * n_rows(recorded, FRAMES)
    add_column(recorded, FRAMES, "observation.images.more", pa.array(rows, type=kind), None)
    declare(recorded, "observation.images.more", {"dtype": "image", "shape": [1, 1, 3], "names": None})
    with pytest.raises(DatasetError, match="expected the bytes of a PNG, JPEG or TIFF"):
        open_local_dataset(recorded)


# ------------------------------------------------------------------------------------------- videos

PLAYLISTS: dict[str, Callable[[int], bytes]] = {
    "hls": lambda port: (
        f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:{port}/a.ts\n#EXT-X-ENDLIST\n".encode()
    ),
    "ffconcat": lambda port: f"ffconcat version 1.0\nfile http://127.0.0.1:{port}/a.mp4\n".encode(),
    "sdp": lambda port: f"v=0\nc=IN IP4 127.0.0.1\nm=video {port} RTP/AVP 96\n".encode(),
    "dash": lambda port: f'<?xml version="1.0"?><MPD xlink:href="http://127.0.0.1:{port}/"/>'.encode(),
    "smil": lambda port: f'<smil><video src="http://127.0.0.1:{port}/a"/></smil>'.encode(),
    "text that calls itself an mp4": lambda port: (
        f"    ftyp<MPD dash:profile:isoff-live:2011><BaseURL>http://127.0.0.1:{port}/</BaseURL></MPD>".encode()
    ),
    "an empty file": lambda _port: b"",
    "a first box without end": lambda _port: b"\0\0\0\1ftypisom" + bytes(50),
    "matroska": lambda _port: b"\x1aE\xdf\xa3" + bytes(50),
}


@pytest.mark.parametrize("name", PLAYLISTS)
def test_a_video_that_is_a_playlist_is_not_opened(recorded: Path, bait: Bait, name: str) -> None:
    content = PLAYLISTS[name](bait.port)
    video = next(recorded.glob("videos/*/*/*.mp4"))
    video.write_bytes(content)
    with pytest.raises(DatasetError, match="expected an MP4 file"):
        open_local_dataset(recorded)
    with pytest.raises(ViewingError, match="expected an MP4 file"):
        open_mp4(video, ViewingError)


def test_ffmpeg_is_told_to_open_no_other_container(
    recorded: Path, bait: Bait, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second lock of videos that we open ourselves: with the check of the first bytes off."""
    import av

    monkeypatch.setattr("vla_eval.viz.mp4.check_mp4", lambda *_: None)
    video = next(recorded.glob("videos/*/*/*.mp4"))
    for make in PLAYLISTS.values():
        video.write_bytes(make(bait.port))
        with pytest.raises(av.error.FFmpegError), open_mp4(video, ViewingError) as container:
            next(container.decode(video=0))


def test_the_videos_that_we_write_pass(recorded: Path) -> None:
    for video in recorded.glob("videos/*/*/*.mp4"):
        check_mp4(video, DatasetError)
        with open_mp4(video, DatasetError) as container:
            assert next(container.decode(video=0)).width == 128


# ------------------------------------------------------------------------------------------- folders


def _content(root: Path) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*"))


def test_no_file_or_folder_may_be_a_link_to_elsewhere(recorded: Path, tmp_path: Path) -> None:
    names = _content(recorded)
    assert len(names) > 10
    for name in names:
        place, away = recorded / name, tmp_path / "away"
        place.rename(away)
        place.symlink_to(away)
        with pytest.raises(DatasetError, match="a link out of the dataset's folder"):
            open_local_dataset(recorded)
        place.unlink()
        away.rename(place)
    open_local_dataset(recorded)


@pytest.mark.parametrize("name", ["meta/more.json", "data/chunk-000/file-001.parquet", "README.md"])
def test_pipes_and_links_to_nothing_are_refused(recorded: Path, name: str) -> None:
    place = recorded / name
    os.mkfifo(place)
    with pytest.raises(DatasetError, match="found a pipe or a device"):
        open_local_dataset(recorded)
    place.unlink()
    for target in ("nowhere", place.name):
        place.symlink_to(target)
        with pytest.raises(DatasetError, match="a link that leads nowhere"):
            open_local_dataset(recorded)
        place.unlink()


def test_links_within_the_dataset_and_into_the_hubs_blobs_are_followed(
    recorded: Path, tmp_path: Path
) -> None:
    """`hf download` without --local-dir gives such a folder."""
    snapshot, blobs = tmp_path / "hub/datasets--a--b/snapshots/abc", tmp_path / "hub/datasets--a--b/blobs"
    blobs.mkdir(parents=True)
    for number, name in enumerate(_content(recorded)):
        if (recorded / name).is_file():
            (snapshot / name).parent.mkdir(parents=True, exist_ok=True)
            (recorded / name).rename(blobs / str(number))
            (snapshot / name).symlink_to(os.path.relpath(blobs / str(number), (snapshot / name).parent))
    (snapshot / "copy.json").symlink_to("meta/info.json")
    assert len(open_local_dataset(snapshot)) == 55


def test_a_link_is_refused_by_every_verb(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_second_task(recorded)
    (tmp_path / "away.png").write_bytes(b"kept")
    (recorded / "images").mkdir()
    (recorded / "images/contact_sheet.png").symlink_to(tmp_path / "away.png")
    for verb, arguments in verbs(recorded, other, tmp_path / "out").items():
        assert main(arguments) == 1, verb
        assert "a link out of the dataset's folder" in capsys.readouterr().err, verb
    assert (tmp_path / "away.png").read_bytes() == b"kept"


@pytest.mark.parametrize("name", ["o[1]", "a::b", "a*b", "50%d", "http:", "a|b"])
def test_the_name_of_the_users_own_folder_does_not_matter(recorded: Path, name: str) -> None:
    place = recorded.rename(recorded.with_name(name))
    assert open_local_dataset(place)[54]["index"] == 54


# ------------------------------------------------------------------------------------------- one reader


READERS = {
    "read_table": "pyarrow",
    "ParquetFile": "pyarrow",
    "ParquetDataset": "pyarrow",
    "read_schema": "pyarrow",
    "read_parquet": "pandas",
    "from_parquet": "datasets",
    "load_dataset": "datasets",
    "load_nested_dataset": "lerobot",
    "LeRobotDataset": "lerobot",
    "LeRobotDatasetMetadata": "lerobot",
    "aggregate_datasets": "lerobot",
    "make_dataset": "lerobot",
}
DOORS = {
    "data/tables.py": {"ParquetFile"},
    "data/opening.py": {"LeRobotDataset", "LeRobotDatasetMetadata", "aggregate_datasets"},
    "training/loop.py": {"make_dataset"},
}


def test_no_other_file_reads_a_datasets_tables() -> None:
    root = Path(vla_eval.__file__).parent
    for path in root.rglob("*.py"):
        name = path.relative_to(root).as_posix()
        tree = ast.parse(path.read_text())
        ours = {
            alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vla_eval")
            for alias in node.names
        }
        called = {
            getattr(node.func, "attr", getattr(node.func, "id", ""))
            for node in ast.walk(tree)
            if isinstance(node, ast.Call)
        }
        assert called & set(READERS) - ours - {"read_table"} <= DOORS.get(name, set()), name
        assert "pq.read" not in path.read_text(), name


def test_the_sentences_are_those_of_their_numbers_whatever_the_order_of_the_file(recorded: Path) -> None:
    before = [open_local_dataset(recorded)[row]["task"] for row in (0, 13)]
    table = pq.read_table(recorded / TASKS)
    pq.write_table(table.take([1, 0]), recorded / TASKS)
    assert [open_local_dataset(recorded)[row]["task"] for row in (0, 13)] == before
    assert before == ["look, wait, choose", "follow the ball"]


def test_a_dataset_written_again_at_the_same_place_is_read_again(recorded: Path) -> None:
    times = os.stat(recorded / FRAMES)
    open_local_dataset(recorded)
    table = pq.read_table(recorded / FRAMES)
    zeros = pa.array([[0.0] * 7] * len(table), type=table.schema.field("action").type)
    pq.write_table(table.set_column(table.column_names.index("action"), "action", zeros), recorded / FRAMES)
    os.utime(recorded / FRAMES, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert open_local_dataset(recorded)[0]["action"].abs().sum() == 0


def test_what_is_not_there_is_not_asked_of_the_hub(recorded: Path, no_network: None) -> None:
    for name in _content(recorded):
        if not (recorded / name).is_file() or name.startswith("meta/mikasa"):
            continue
        content = (recorded / name).read_bytes()
        (recorded / name).unlink()
        if name != "meta/stats.json":
            with pytest.raises(DatasetError):
                open_local_dataset(recorded)
        (recorded / name).write_bytes(content)


def test_datasets_of_version_2_are_recognised(recorded: Path) -> None:
    file = recorded / "meta/info.json"
    for version, said in (("v2.1", "convert_dataset_v21_to_v30"), ("v99.0", "expected a version 3")):
        file.write_text(json.dumps({**json.loads(file.read_text()), "codebase_version": version}))
        with pytest.raises(DatasetError, match=said):
            open_local_dataset(recorded)
    shutil.rmtree(recorded)
