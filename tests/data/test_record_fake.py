"""Recording and replaying on the fake simulator: resume, damage, contract, lerobot's loader."""

import ctypes
import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from torch.utils.data import DataLoader

from tests.data.hostile_datasets import Bait, addresses, hostile_columns
from tests.data.replays import passed
from tests.forked import Forked, start_command
from tests.waiting import is_alive, wait_until
from vla_eval.cli.main import main
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.data.dataset_folder import check_dataset
from vla_eval.data.facts import read_facts
from vla_eval.data.frames.decoded_frames import DecodedFramesDataset
from vla_eval.data.manifest import MANIFEST_FILE, RECORDING_FILE, read_manifest
from vla_eval.data.opening import open_dataset
from vla_eval.data.recording import record as recording_module
from vla_eval.data.recording.demonstrations import Attempt
from vla_eval.data.recording.folder import LOCK_FILE, STATE_FOLDER
from vla_eval.data.recording.jobs import AttemptJob, ShardJob
from vla_eval.data.recording.plan import plan_recording
from vla_eval.data.recording.record import RecordedDataset, record
from vla_eval.data.recording.shard_writer import ShardWriter
from vla_eval.data.recording.worker import RecordingRunner
from vla_eval.data.replaying import replay as replay_module
from vla_eval.data.sharing.initial_states import read_initial_states
from vla_eval.data.sharing.leak import check_leak
from vla_eval.data.tables import read_columns
from vla_eval.errors import DatasetError, RecordingError, RunChangedError, RunFolderError
from vla_eval.storage.durable import FolderLock
from vla_eval.strict.decoding import decode
from vla_eval.training import held_out
from vla_eval.training.dataset import training_dataset
from vla_eval.workers.inside import Heartbeat
from vla_eval.workers.messages import Failed

TASK = "RememberColor3-v0"
FIELDS: dict[str, Any] = {
    "name": "test",
    "tasks": [TASK],
    "episodes": 6,
    "episodes_per_shard": 2,
    "simulator": "fake",
    "workers": 1,
}
N_EPISODES = 6


def recipe(**fields: Any) -> DatasetRecipe:
    return decode(DatasetRecipe, {**FIELDS, **fields}, where="test")


@pytest.fixture(scope="module", autouse=True)
def _same_environment() -> Any:
    # Others may be editing the package while this runs: its digest would change.
    with pytest.MonkeyPatch.context() as patch:
        for module in (recording_module, replay_module):
            patch.setattr(module, "collect_environment", lambda: {"machine": "test"})
        yield


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> RecordedDataset:
    """Six episodes, recorded without interruption by one worker."""
    summary = record(recipe(), out=tmp_path_factory.mktemp("recorded") / "out")
    (dataset,) = summary.datasets
    return dataset


@pytest.fixture
def copy(recorded: RecordedDataset, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    path = tmp_path / "copy" / TASK
    shutil.copytree(recorded.path, path)
    return path


class TestDataset:
    def test_it_is_complete_and_nothing_else_is_left(self, recorded: RecordedDataset) -> None:
        facts = check_dataset(recorded.path)
        assert facts.n_episodes == N_EPISODES
        assert facts.n_failed_seeds == 0
        left = [path.name for path in (recorded.path.parent / STATE_FOLDER / TASK).iterdir()]
        assert left == ["attempts.jsonl"]

    def test_lerobot_reads_what_the_manifest_says(self, recorded: RecordedDataset) -> None:
        episodes = read_manifest(recorded.path)
        dataset = open_dataset(recorded.path).lerobot(delta_timestamps={"action": [0.0, 0.05]})

        assert [episode.seed for episode in episodes] == list(range(1000, 1000 + N_EPISODES))
        assert dataset.num_episodes == N_EPISODES
        assert dataset.num_frames == sum(episode.n_steps for episode in episodes)
        second = int(dataset.meta.episodes[1]["dataset_from_index"])
        assert second == episodes[0].n_steps
        item = dataset[second]
        assert item["task"] == episodes[1].instruction
        assert np.array_equal(item["action"].numpy(), episodes[1].action_rows()[:2])
        assert item["observation.images.base"].shape == (3, 128, 128)
        assert item["observation.state"].shape == (10,)
        assert item["proprio.joints"].shape == (25,)

    def test_flags_of_a_frame_are_those_of_its_action(self, recorded: RecordedDataset) -> None:
        columns = read_columns(recorded.path)
        for episode in read_manifest(recorded.path):
            mine = columns["episode_index"] == episode.episode_index
            success, done = columns["next.success"][mine], columns["next.done"][mine]
            assert int(np.argmax(success)) == episode.success_step - 1  # type: ignore[operator]
            assert done.tolist() == [False] * (episode.n_steps - 1) + [True]
            assert episode.n_steps == episode.success_step + 5  # type: ignore[operator]

    def test_statistics_are_exact(self, recorded: RecordedDataset) -> None:
        stats = json.loads((recorded.path / "meta/stats.json").read_text())
        state = np.stack(list(read_columns(recorded.path)["observation.state"])).astype(np.float64)
        assert stats["observation.state"]["q01"] == pytest.approx(np.quantile(state, 0.01, axis=0))
        assert stats["observation.state"]["q99"] == pytest.approx(np.quantile(state, 0.99, axis=0))
        # The fake's pictures are uniform noise below a strip of 8 of 128 rows.
        mean = np.array(stats["observation.images.base"]["mean"])
        assert mean.shape == (3, 1, 1)
        assert mean.ravel() == pytest.approx([0.5 * 120 / 128] * 3, abs=0.02)

    def test_the_same_command_again_finds_all_done(self, recorded: RecordedDataset) -> None:
        again = record(recipe(), out=recorded.path.parent)
        assert again.datasets[0].facts == recorded.facts

    def test_a_changed_recipe_is_refused_and_says_what_changed(self, recorded: RecordedDataset) -> None:
        with pytest.raises(RunChangedError, match=r"config.steps_after_success: 5 -> 3"):
            record(recipe(steps_after_success=3), out=recorded.path.parent)

    def test_its_seeds_are_found_among_those_of_an_evaluation(
        self, recorded: RecordedDataset, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        report = check_leak(read_initial_states(recorded.path), task=TASK, seeds=range(998, 1002))
        found = [(one.episode, one.dataset_seed, one.evaluation_seed) for one in report.shared]
        assert found == [("episode 0", 1000, 1000), ("episode 1", 1001, 1001)]
        dataset = open_dataset(recorded.path)
        assert held_out.shared_seeds_warning(dataset) is None
        monkeypatch.setattr(held_out, "EVALUATION_SEEDS", range(1004, 1050))
        assert "2 seeds that tables are made from (1004 … 1005)" in str(
            held_out.shared_seeds_warning(dataset)
        )

    def test_two_processes_cannot_record_into_one_folder(self, tmp_path: Path) -> None:
        (tmp_path / STATE_FOLDER).mkdir()
        lock = FolderLock(tmp_path / STATE_FOLDER / LOCK_FILE)
        try:
            with pytest.raises(RunFolderError, match=f"another process \\(pid {os.getpid()}\\)"):
                record(recipe(), out=tmp_path)
        finally:
            lock.release()

    def test_a_folder_of_something_else_is_left_alone(self, tmp_path: Path) -> None:
        (tmp_path / "thesis.tex").touch()
        with pytest.raises(RunFolderError, match=r"holds other files \(thesis.tex\)"):
            record(recipe(), out=tmp_path)


class TestDamage:
    def test_a_changed_byte_is_found(self, copy: Path) -> None:
        video = next(copy.rglob("*.mp4"))
        content = bytearray(video.read_bytes())
        content[len(content) // 2] ^= 1
        video.write_bytes(content)
        with pytest.raises(DatasetError, match="its content is not what was recorded"):
            open_dataset(copy).lerobot()

    def test_a_file_cut_short_is_found_without_reading_it(self, copy: Path) -> None:
        video = next(copy.rglob("*.mp4"))
        os.truncate(video, 1000)
        with pytest.raises(DatasetError, match=r"expected \d+ bytes, found 1000"):
            check_dataset(copy)

    def test_a_missing_file_is_an_error_and_no_download(self, copy: Path) -> None:
        next(copy.rglob("data/**/*.parquet")).unlink()
        with pytest.raises(DatasetError, match=r"data/.*parquet is missing.*--rebuild OUT"):
            open_dataset(copy).lerobot()

    def test_an_unfinished_dataset_cannot_be_opened(self, copy: Path) -> None:
        (copy / RECORDING_FILE).unlink()
        with pytest.raises(DatasetError, match="not a complete dataset of this project"):
            open_dataset(copy).lerobot()


class TestKill:
    def start(self, out: Path) -> Forked:
        command = ["record", "--task", TASK, "--episodes", str(N_EPISODES), "--workers", "2"]
        command += ["--set", "simulator=fake", "--set", "episodes_per_shard=2", "--set", "name=test"]
        command += ["--allow-environment-change", "--no-replay", "--out", str(out)]
        return start_command(command, out.parent)

    def kill_when(self, command: Forked, holds: Callable[[], bool]) -> None:
        wait_until(lambda: holds() or not is_alive(command.pid))
        os.kill(command.pid, signal.SIGKILL)
        command.wait()

    def test_killed_twice_and_by_two_workers_it_is_the_same_dataset_which_replays_and_is_trained_on(
        self, recorded: RecordedDataset, tmp_path: Path
    ) -> None:
        out = tmp_path / "out"
        state = out / STATE_FOLDER / TASK
        self.kill_when(
            self.start(out),
            lambda: (state / "attempts.jsonl").exists() and b"\n" in (state / "attempts.jsonl").read_bytes(),
        )
        assert not (out / TASK).exists()
        self.kill_when(self.start(out), lambda: any(state.glob("shards/shard-0000?")))
        assert not (out / TASK).exists()
        with pytest.raises(DatasetError, match="no finished dataset"):
            replay_module.find_datasets(out)

        assert self.start(out).wait().returncode == 0

        # Tables, videos, statistics and manifest: each file byte for byte.
        assert check_dataset(out / TASK).files == recorded.facts.files

        with pytest.raises(DatasetError, match="no replay has confirmed this dataset"):
            training_dataset(out / TASK, allow_unreplayed=False)
        assert main(["replay", str(out / TASK), "--workers", "1"]) == 0
        assert training_dataset(out / TASK, allow_unreplayed=False).sha256
        window = {"action": [0.0, 0.05]}
        source = open_dataset(out / TASK).lerobot(delta_timestamps=window)
        served = DecodedFramesDataset(source, cache=tmp_path / "cache")
        batch = next(iter(DataLoader(served, batch_size=4)))
        assert batch["action"].shape == (4, 2, 7)
        # lerobot's own dataset decodes the same pictures.
        assert torch.equal(batch["observation.images.wrist"][3], source[3]["observation.images.wrist"])


class TestReplay:
    def replay(self, *arguments: str) -> int:
        return main(["replay", *arguments, "--workers", "1"])

    def test_a_dataset_is_what_it_says(self, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert self.replay(str(copy), "--pixels") == 0
        output = capsys.readouterr().out
        assert f"{N_EPISODES} of {N_EPISODES} episodes replayed: as recorded; states bit-equal" in output
        report = passed(copy)
        assert report is not None
        assert report.pixels
        assert set(report.lowest_psnr_db) == {"base_camera", "hand_camera"}
        check_dataset(copy)  # the report is no part of what was recorded

    def test_nothing_that_a_column_names_is_opened(
        self, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        bait = Bait(tmp_path / "mark", tmp_path / "secret", 9)
        for way in hostile_columns(copy, addresses(bait)["reference"], "Image"):
            if "episodes" in way or "struct" in way:
                code = self.replay(str(copy), "--pixels", "--episodes", "0")
                assert "Traceback" not in capsys.readouterr().err
                assert code == (0 if "text" in way else 1), way
        assert not bait.mark.exists()

    def test_changed_actions_and_seeds_are_found(
        self, copy: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        table = next(copy.rglob("data/**/*.parquet"))
        frames = pq.read_table(table)
        actions = np.stack(frames["action"].to_pylist()).astype(np.float32)
        actions[0, 6] *= -1  # the gripper's sign, of the first frame of the first episode
        index = frames.schema.get_field_index("action")
        column = pa.chunked_array([pa.array(actions.tolist(), type=frames.schema.field(index).type)])
        changed = frames.set_column(index, frames.schema.field(index), column)
        pq.write_table(changed, table)
        lines = (copy / MANIFEST_FILE).read_text().splitlines()
        lines[1] = lines[1].replace('"seed": 1001', '"seed": 2003')
        (copy / MANIFEST_FILE).write_text("\n".join(lines) + "\n")

        assert self.replay(str(copy), "--episodes", "0", "1", "2") == 1

        output = capsys.readouterr().out.splitlines()
        assert f"{copy}: episode 0 (seed 1000): the actions of the table are not those of the" in output[0]
        # The fake's states are those of the arm alone; what another seed moves is the right candidate.
        assert any(f"{copy}: episode 1 (seed 2003): first success at step" in line for line in output)
        assert not any("episode 2" in line for line in output)
        with pytest.raises(DatasetError, match="its replay failed with"):
            passed(copy)

    def test_an_episode_that_is_not_there(self, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert self.replay(str(copy), "--episodes", "6") == 1
        assert "there is no episode 6; it has the episodes 0 to 5" in capsys.readouterr().err

    def test_another_version_of_the_task_is_refused(
        self, copy: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        text = (copy / MANIFEST_FILE).read_text()
        (copy / MANIFEST_FILE).write_text(text.replace('"task_version": 1', '"task_version": 99'))
        assert self.replay(str(copy)) == 1
        assert "recorded with version 99 of RememberColor3-v0" in capsys.readouterr().err

    def test_a_dataset_is_made_again_from_its_manifest_alone(
        self, recorded: RecordedDataset, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        for folder in ("data", "videos", "meta/episodes"):
            shutil.rmtree(copy / folder)

        assert self.replay(str(copy), "--rebuild", str(tmp_path / "new")) == 0

        assert f"are those that were recorded: {N_EPISODES} of {N_EPISODES}" in capsys.readouterr().out
        assert check_dataset(tmp_path / "new" / TASK).files == recorded.facts.files


class TestWorker:
    """The inside of a worker, in this process."""

    @pytest.fixture
    def runner(self) -> RecordingRunner:
        return RecordingRunner(Heartbeat((ctypes.c_double * 2)()), lambda _device: None)

    def test_an_expert_with_noise_stores_what_the_recipe_says(self, runner: RecordingRunner) -> None:
        (task,) = plan_recording(recipe(action_noise=0.1, stored_action="intended")).tasks
        one = runner.answer(AttemptJob(plan=task, seed=1000))
        assert isinstance(one, Attempt)
        assert one.intended_actions is not None

    def test_a_full_disk_is_a_clear_stop(
        self, runner: RecordingRunner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (task,) = plan_recording(recipe()).tasks
        one = runner.answer(AttemptJob(plan=task, seed=1000))
        assert isinstance(one, Attempt)

        def fail(*_arguments: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(ShardWriter, "add_episode", fail)
        path = tmp_path / "shards" / "shard-00000"
        failed = runner.answer(ShardJob(plan=task, path=path, first_index=0, attempts=(one,)))

        assert isinstance(failed, Failed)
        assert failed.refused  # ends the recording at once
        assert failed.error.kind == "StorageFullError"
        assert "No space left on device" in failed.error.message
        assert list(path.parent.iterdir()) == []

    def test_a_shard_that_was_begun_before_is_begun_again(
        self, runner: RecordingRunner, tmp_path: Path
    ) -> None:
        (task,) = plan_recording(recipe()).tasks
        one = runner.answer(AttemptJob(plan=task, seed=1000))
        assert isinstance(one, Attempt)
        path = tmp_path / "shard-00000"
        (tmp_path / "shard-00000.123.draft").mkdir()  # of a process that was killed

        runner.answer(ShardJob(plan=task, path=path, first_index=0, attempts=(one,)))

        assert [entry.name for entry in tmp_path.iterdir()] == ["shard-00000"]


@pytest.mark.slow
def test_a_worker_that_dies_is_reported_with_its_last_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dying_expert.py").write_text(
        "import os, sys\n"
        "def make(context):\n"
        "    print('these are my last words', file=sys.stderr, flush=True)\n"
        "    os._exit(7)\n"
    )
    (tmp_path / "dying.yaml").write_text("version: 1\ndescription: d\nadapter: dying_expert:make\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(RecordingError, match="exited with code 7") as caught:
        record(recipe(expert=str(tmp_path / "dying.yaml")), out=tmp_path / "out")
    assert "these are my last words" in str(caught.value)


def test_facts_do_not_say_how_many_workers_there_were(recorded: RecordedDataset) -> None:
    assert "workers" not in read_facts(recorded.path).recipe
