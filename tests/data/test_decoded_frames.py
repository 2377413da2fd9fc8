"""`DecodedFramesDataset` serves what lerobot serves, from frames that were decoded once."""

import pickle
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from vla_eval.data.frames import frame_cache
from vla_eval.data.frames.decoded_frames import DecodedFramesDataset
from vla_eval.data.opening import open_local_dataset, video_decoder
from vla_eval.errors import DatasetError, StorageFullError, UnknownNameError
from vla_eval.strict.decoding import warn_renamed
from vla_eval.testing.synthetic import write_synthetic_dataset

BASE, WRIST = "observation.images.base", "observation.images.wrist"
# A chunk of eight actions, four frames of one camera and two states: windows as policies ask for them.
WINDOWS = {
    "action": [i / 20 for i in range(8)],
    BASE: [-3 / 20, -2 / 20, -1 / 20, 0.0],
    "observation.state": [-1 / 20, 0.0],
    "next.reward": [0.0],
}
N_EPISODES, N_FRAMES = 4, 6  # lengths 6, 7, 8, 6


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("loader") / "tiny"
    return write_synthetic_dataset(folder, n_episodes=N_EPISODES, n_frames=N_FRAMES)


def load(root: Path, **options: Any) -> LeRobotDataset:
    return LeRobotDataset("local/tiny", root=root, **options)


def assert_same(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert list(ours) == list(theirs)  # order, too: collation keeps it
    for key, value in theirs.items():
        if isinstance(value, torch.Tensor):
            assert ours[key].dtype == value.dtype, key
            assert torch.equal(ours[key], value), key  # compares shapes and every bit pattern of numbers
        else:
            assert ours[key] == value, key


@pytest.mark.sampled(5)
@pytest.mark.parametrize("storage", ["disk", pytest.param("ram", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"delta_timestamps": WINDOWS},
        {"delta_timestamps": WINDOWS, "return_uint8": True},
        {"delta_timestamps": WINDOWS, "episodes": [1, 3]},
        {"image_transforms": lambda image: image.flip(-1)},
    ],
    ids=["plain", "windows", "uint8", "some-episodes", "transforms"],
)
def test_every_sample_is_the_one_of_lerobot(
    root: Path, tmp_path: Path, storage: Any, options: dict[str, Any]
) -> None:
    theirs = load(root, **options)
    ours = DecodedFramesDataset(theirs, storage=storage, cache=tmp_path)

    assert len(ours) == len(theirs) == (13 if "episodes" in options else 27)
    for index in range(len(theirs)):
        assert_same(ours[index], theirs[index])


def test_the_end_of_an_episode_is_padded_with_its_last_action(root: Path, tmp_path: Path) -> None:
    ours = DecodedFramesDataset(load(root, delta_timestamps=WINDOWS), cache=tmp_path)
    last = ours[N_FRAMES - 1]  # the last frame of the first episode

    # Eight actions from the last frame on: one real one, then seven that the episode does not have.
    assert last["action_is_pad"].tolist() == [False] + [True] * 7
    assert torch.equal(last["action"], last["action"][:1].expand(8, -1))


def test_a_sample_may_be_the_whole_episode_for_each_of_its_frames(root: Path, tmp_path: Path) -> None:
    theirs = load(root, delta_timestamps=WINDOWS)
    ours = DecodedFramesDataset(theirs, cache=tmp_path, whole_episodes=True)
    assert len(ours) == len(theirs)
    for first, last in ((0, 5), (6, 12)):  # the first two episodes
        assert_same(ours[first], theirs[last])
        assert_same(ours[last], theirs[last])


def test_samples_are_copies(root: Path, tmp_path: Path) -> None:
    ours = DecodedFramesDataset(load(root), storage="ram", cache=tmp_path)
    before = ours[0]
    for value in ours[0].values():
        if isinstance(value, torch.Tensor):
            value.zero_()

    assert_same(ours[0], before)


def test_frames_are_decoded_once(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = DecodedFramesDataset(load(root), cache=tmp_path)[5]

    def decode(*_: object, **__: object) -> None:
        raise AssertionError("decoded again")

    monkeypatch.setattr(frame_cache, "decode_video_frames", decode)

    assert_same(DecodedFramesDataset(load(root), cache=tmp_path)[5], first)


def test_another_recording_of_the_same_name_gets_frames_of_its_own(root: Path, tmp_path: Path) -> None:
    other = write_synthetic_dataset(tmp_path / "tiny", n_episodes=N_EPISODES, n_frames=N_FRAMES, seed=1)

    DecodedFramesDataset(load(root), cache=tmp_path / "cache")
    ours = DecodedFramesDataset(load(other), cache=tmp_path / "cache")

    assert_same(ours[3], load(other)[3])


def test_a_loader_in_other_processes_maps_the_file_instead_of_copying_it(root: Path, tmp_path: Path) -> None:
    ours = DecodedFramesDataset(load(root, delta_timestamps=WINDOWS), cache=tmp_path)
    frames_bytes = 27 * 2 * 128 * 128 * 3

    travelled = pickle.dumps(ours)

    assert len(travelled) < frames_bytes / 10
    assert_same(pickle.loads(travelled)[20], ours[20])


@pytest.mark.slow  # a spawned process imports torch and lerobot again
def test_a_data_loader_with_workers_serves_the_same(root: Path, tmp_path: Path) -> None:
    theirs = load(root, delta_timestamps=WINDOWS)
    ours = DecodedFramesDataset(theirs, cache=tmp_path)
    loader = torch.utils.data.DataLoader(ours, batch_size=9, num_workers=1, multiprocessing_context="spawn")

    batches = list(loader)

    assert [len(batch["task"]) for batch in batches] == [9, 9, 9]
    assert torch.equal(batches[1][BASE][4], theirs[13][BASE])


def test_builders_that_start_together_decode_once_and_agree(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Threads stand for processes: the lock belongs to the open file, of which each has one.
    n_builds = []
    build = frame_cache._build
    monkeypatch.setattr(frame_cache, "_build", lambda *args: (n_builds.append(1), build(*args)))
    sources = [load(root) for _ in range(3)]

    with ThreadPoolExecutor(3) as pool:
        loaded = list(pool.map(lambda source: DecodedFramesDataset(source, cache=tmp_path), sources))

    assert len(n_builds) == 1
    (folder,) = (path for path in (tmp_path / "frames").iterdir() if path.is_dir())
    assert sorted(path.name for path in folder.iterdir()) == [f"{BASE}.npy", f"{WRIST}.npy"]
    for dataset in loaded:
        assert_same(dataset[7], sources[0][7])


def test_what_a_killed_builder_left_is_never_served(root: Path, tmp_path: Path) -> None:
    theirs = load(root)
    final = DecodedFramesDataset(theirs, cache=tmp_path)._files[BASE].parent
    half = final.with_name(f"{final.name}.123.tmp")
    final.rename(half)
    (half / f"{BASE}.npy").write_bytes(b"half a file")

    assert_same(DecodedFramesDataset(theirs, cache=tmp_path)[0], theirs[0])
    assert not half.exists()


def test_too_small_a_disk_is_noticed_before_decoding(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=5 * 2**20)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)

    # 27 frames × 2 cameras × 128 × 128 × 3 bytes = 2 654 208 = 2.5 MiB, plus 16 MiB of headroom.
    with pytest.raises(DatasetError, match=r"27 frames of 2 cameras take 3 MiB decoded, but 5 MiB are free"):
        DecodedFramesDataset(load(root), cache=tmp_path)
    assert [path for path in (tmp_path / "frames").iterdir() if path.is_dir()] == []


def test_too_little_ram_is_noticed_before_decoding(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_cache, "available_ram_bytes", lambda: 2**20)

    with pytest.raises(DatasetError, match=r"1 MiB of RAM are free. Use storage='disk'"):
        DecodedFramesDataset(load(root), storage="ram")


def test_the_old_name_of_ram_still_works_with_a_warning(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    warn_renamed.cache_clear()
    source = load(root)
    ours = DecodedFramesDataset(source, storage="memory")
    assert_same(ours[0], source[0])
    assert "storage='memory' is now called storage='ram'" in caplog.text


def test_a_mistyped_storage_is_refused(root: Path) -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'ram'"):
        DecodedFramesDataset(load(root), storage="rma")  # type: ignore[arg-type]


def test_a_disk_that_becomes_full_is_a_clear_stop_and_leaves_nothing(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(frame_cache, "_write_camera", full)

    with pytest.raises(StorageFullError, match="became full"):
        DecodedFramesDataset(load(root), cache=tmp_path)
    assert [path for path in (tmp_path / "frames").iterdir() if path.is_dir()] == []


def test_a_damaged_video_is_named(root: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    video = next((copy / "videos" / WRIST).rglob("*.mp4"))
    video.write_bytes(b"no video")

    with pytest.raises(DatasetError, match=rf"{WRIST}.*cannot be decoded"):
        DecodedFramesDataset(load(copy), cache=tmp_path)


def test_a_misspelt_window_gets_a_suggestion(root: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'action'"):
        DecodedFramesDataset(load(root, delta_timestamps={"actions": [0.0]}), cache=tmp_path)


def test_an_index_beyond_the_end(root: Path, tmp_path: Path) -> None:
    ours = DecodedFramesDataset(load(root), cache=tmp_path)

    assert_same(ours[-1], ours[26])
    with pytest.raises(IndexError):
        ours[27]


def test_a_folder_without_a_dataset_and_one_without_a_video_are_named(tmp_path: Path, root: Path) -> None:
    with pytest.raises(DatasetError, match=r"no meta/info.json. Name the folder"):
        open_local_dataset(tmp_path)
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    next((copy / "videos" / WRIST).rglob("*.mp4")).unlink()
    # lerobot itself would ask the Hub for it.
    with pytest.raises(DatasetError, match=rf"videos/{WRIST}/chunk-000/file-000.mp4 is missing"):
        open_local_dataset(copy)


def test_where_torchcodec_cannot_be_loaded_pyav_decodes_and_nobody_is_shown_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_synthetic_dataset(tmp_path / "data", n_episodes=1, n_frames=3)
    video_decoder.cache_clear()
    caplog.clear()
    monkeypatch.setitem(sys.modules, "torchcodec", None)  # importing it is an ImportError then
    try:
        dataset = open_local_dataset(root)
    finally:
        video_decoder.cache_clear()
    assert dataset._video_backend == "pyav"
    assert "torchcodec" not in caplog.text
