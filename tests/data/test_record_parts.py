"""Parts of a recording on the fake simulator: merged, they are the files of one recording."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from vla_eval.cli.main import main
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.data.dataset_folder import check_dataset
from vla_eval.data.manifest import read_manifest
from vla_eval.data.recording import record as recording_module
from vla_eval.data.recording.folder import ATTEMPTS_FILE, STATE_FOLDER, shard_path
from vla_eval.data.recording.merging import merge_recordings, write_recording
from vla_eval.data.recording.record import RecordingSummary, record
from vla_eval.errors import MergeError, RecipeError
from vla_eval.storage.shard import Shard
from vla_eval.strict.decoding import decode

TASK = "RememberColor3-v0"


def recipe(**fields: Any) -> DatasetRecipe:
    known = {
        "name": "test",
        "tasks": [TASK],
        "episodes": 5,
        "episodes_per_shard": 2,
        "simulator": "fake",
        "workers": 1,
    }
    return decode(DatasetRecipe, {**known, **fields}, where="test")


@pytest.fixture(scope="module", autouse=True)
def _same_environment() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording_module, "collect_environment", lambda: {"machine": "test"})
        yield


def record_part(out: Path, number: int) -> RecordingSummary:
    return record(recipe(), out=out, part=Shard(number=number, count=2))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one whole recording, `one`, and the same in two parts, `part-1` and `part-2`."""
    home = tmp_path_factory.mktemp("recorded")
    record(recipe(), out=home / "one")
    parts = [record_part(home / f"part-{number}", number).parts for number in (1, 2)]
    # Episodes 0 1 | 2 3 | 4: the first and the last two go to part 1.
    assert [part.n_episodes for (part,) in parts] == [3, 2]
    return home


@pytest.fixture
def home(recorded: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(recorded, tmp_path / "copy"))


def files(root: Path) -> dict[str, bytes]:
    return {
        path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }


@pytest.mark.slow
def test_the_merged_dataset_has_the_bytes_of_one_recording(home: Path) -> None:
    (facts,) = write_recording(merge_recordings([home / "part-2", home / "part-1"]), home / "merged")

    assert files(home / "merged" / TASK) == files(home / "one" / TASK)
    assert check_dataset(home / "merged" / TASK) == facts
    seeds = [episode.seed for episode in read_manifest(home / "merged" / TASK)]
    assert seeds == sorted(seeds)
    left = [path.name for path in (home / "merged" / STATE_FOLDER / TASK).iterdir()]
    assert left == [ATTEMPTS_FILE]


def test_a_merged_recording_is_finished_for_the_command_that_records_it_whole(home: Path) -> None:
    write_recording(merge_recordings([home / "part-1", home / "part-2"]), home / "merged")

    summary = record(recipe(), out=home / "merged")

    assert [dataset.facts.n_episodes for dataset in summary.datasets] == [5]


def test_a_shard_that_is_not_rendered_is_named_and_the_whole_is_resumed_without_it(home: Path) -> None:
    shutil.rmtree(shard_path(home / "part-2", TASK, 1))
    merged = merge_recordings([home / "part-1", home / "part-2"])

    assert [line.partition(" To resume")[0] for line in merged.missing] == [
        f"{home / 'part-2'} (shard 2/2): {TASK}: shard-00001 is not rendered."
    ]
    assert write_recording(merged, home / "merged") == ()
    record(recipe(), out=home / "merged")
    assert files(home / "merged" / TASK) == files(home / "one" / TASK)


def test_a_part_that_was_stopped_while_it_tried_seeds_is_named(home: Path) -> None:
    path = home / "part-2" / STATE_FOLDER / TASK / ATTEMPTS_FILE
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))

    (missing, *_) = merge_recordings([home / "part-1", home / "part-2"]).missing

    assert missing.startswith(f"{home / 'part-2'} (shard 2/2): {TASK}: not all seeds are tried.")


def test_a_part_that_had_not_begun_is_merged_to_a_recording_without_attempts(home: Path) -> None:
    shutil.rmtree(home / "part-1" / STATE_FOLDER / TASK)
    merged = merge_recordings([home / "part-1"])

    assert write_recording(merged, home / "merged") == ()
    assert "not all seeds are tried" in merged.missing[1]
    assert list((home / "merged" / STATE_FOLDER / TASK).iterdir()) == []


def test_an_expert_that_acted_differently_is_refused(home: Path) -> None:
    path = home / "part-2" / STATE_FOLDER / TASK / ATTEMPTS_FILE
    first, *others = path.read_text().splitlines()
    path.write_text("\n".join([first.replace('"states_sha256": "', '"states_sha256": "0'), *others, ""]))

    with pytest.raises(MergeError, match="seed 1000 differs"):
        merge_recordings([home / "part-1", home / "part-2"])


def test_a_missing_part_is_refused_on_the_command_line(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["merge", str(home / "part-1"), "--out", str(home / "merged")]) == 1
    assert "no folder of shard 2/2 was named" in capsys.readouterr().err
    assert not (home / "merged").exists()


def test_more_parts_than_shards_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"at most 3 shards.* 2 of which stay together"):
        record(recipe(), out=tmp_path / "out", part=Shard(number=1, count=4))
