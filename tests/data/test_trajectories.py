"""Datasets read in the layout of the paper's offline reinforcement learning."""

from pathlib import Path

import numpy as np
import pytest

from tests.data.failed_episodes import let_fail
from vla_eval.data.foreign.npz_files import read_npz
from vla_eval.data.frames.decoded_frames import DecodedFramesDataset
from vla_eval.data.opening import open_local_dataset
from vla_eval.data.sharing.trajectories import Trajectories, Trajectory


@pytest.fixture
def episodes(recorded: Path, tmp_path: Path) -> Trajectories:
    return Trajectories(let_fail(recorded, 1), cache=tmp_path / "cache")


def rewarded(*dense: float, success: tuple[int, ...]) -> Trajectory:
    n_steps = len(dense)
    return Trajectory(
        rgb_THWC=np.zeros((n_steps, 2, 2, 6), np.uint8),
        joints_TD=np.zeros((n_steps, 25), np.float32),
        actions_TA=np.zeros((n_steps, 8), np.float32),
        dense_rewards_T=np.array(dense, np.float32),
        success_T=np.isin(np.arange(n_steps), success),
        done_T=np.arange(n_steps) == n_steps - 1,
    )


def test_an_episode_has_the_arrays_of_the_papers_files(episodes: Trajectories, recorded: Path) -> None:
    arrays = episodes[2].arrays()
    assert {name: array.shape for name, array in arrays.items()} == {
        **{"rgb": (15, 128, 128, 6), "joints": (15, 25), "action": (15, 7)},
        **{"reward": (15,), "success": (15,), "done": (15,)},
    }
    assert (arrays["rgb"].dtype, arrays["success"].dtype) == (np.uint8, np.int64)
    sample = DecodedFramesDataset(open_local_dataset(recorded))[13 + 14 + 5]
    base, wrist = (sample[f"observation.images.{name}"].numpy() for name in ("base", "wrist"))
    shown = np.concatenate([base, wrist]).transpose(1, 2, 0)  # in [0, 1]
    np.testing.assert_allclose(arrays["rgb"][5] / 255, shown, atol=1e-6)
    np.testing.assert_array_equal(arrays["joints"][5], sample["proprio.joints"])
    np.testing.assert_array_equal(arrays["reward"][5], sample["next.reward"].squeeze())


def test_what_reads_the_papers_files_reads_them(episodes: Trajectories, tmp_path: Path) -> None:
    np.savez(tmp_path / "train_data_0.npz", **episodes[0].arrays())
    read, left_out = read_npz(tmp_path / "train_data_0.npz")
    assert list(left_out) == []
    np.testing.assert_array_equal(read.read_images()[1], episodes[0].rgb_THWC[..., 3:])
    assert read.numbers["next.success"].tolist() == [0] * 12 + [1]


def test_failures_are_there_and_say_so(episodes: Trajectories) -> None:
    assert len(episodes) == 4
    assert [one.succeeds for one in episodes] == [True, False, True, True]
    assert [one.done_T.tolist().index(True) for one in episodes[1:3]] == [13, 14]


def test_returns_are_what_is_still_to_come() -> None:
    episode = rewarded(0.25, 0.5, 1.0, 1.0, success=(2, 3))
    assert episode.rewards("success").tolist() == [0, 0, 1, 1]
    assert episode.rewards("sparse").tolist() == [0, 0, 1, 0]
    assert episode.returns_to_go("success").tolist() == [2, 2, 2, 1]
    assert episode.returns_to_go("sparse").tolist() == [1, 1, 1, 0]
    assert episode.returns_to_go("dense").tolist() == [2.75, 2.5, 2, 1]
    # 0.25 + 0.5 · (0.5 + 0.5 · (1 + 0.5 · 1)) = 0.25 + 0.5 · 1.25
    assert episode.returns_to_go("dense", discount=0.5).tolist() == [0.875, 1.25, 1.5, 1.0]


def test_changing_an_episode_changes_nothing_that_is_read_later(episodes: Trajectories) -> None:
    first = episodes[-1]
    first.actions_TA[:] = 9
    first.rgb_THWC[:] = 9
    assert not (episodes[3].actions_TA == 9).any()
    assert not (episodes[3].rgb_THWC == 9).all()
