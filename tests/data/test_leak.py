"""`dataset check-leak`: demonstrations that begin as episodes of an evaluation are found, others not."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vla_eval.cli.main import main
from vla_eval.config.environment import EnvSettings
from vla_eval.data.foreign.changes import Changes
from vla_eval.data.foreign.convert import convert_to_lerobot, find_source
from vla_eval.data.sharing.initial_states import InitialState, InitialStates, read_initial_states
from vla_eval.data.sharing.leak import check_leak
from vla_eval.envs.factory import make_env
from vla_eval.errors import DatasetError
from vla_eval.features import proprioception
from vla_eval.tasks.catalog import task_spec

TASK = "RememberColor3-v0"
CAMERAS = ("base_camera", "hand_camera")


def fake_dataset(seeds: Sequence[int]) -> InitialStates:
    """Demonstrations on the fake simulator, whose arm begins in the same state for all seeds."""
    env = make_env(EnvSettings(task=TASK, simulator="fake", cameras=CAMERAS))
    begun = [env.reset({0: seed}, render=True)[0].observation for seed in seeds]
    env.close()
    return InitialStates(
        path=Path("data/x"),
        task=TASK,
        simulator="fake",
        episodes=tuple(
            InitialState(
                name=f"episode {number}", seed=None, kind="eef", state=proprioception(one.state)["eef"]
            )
            for number, one in enumerate(begun)
        ),
        read_frames=lambda: [dict(one.images) for one in begun],
    )


@pytest.mark.parametrize(("seeds", "found"), [(range(7, 10), [1]), (range(8, 9), [1]), (range(1, 6), [])])
def test_first_frames_decide_where_the_arm_always_begins_alike(seeds: range, found: list[int]) -> None:
    report = check_leak(fake_dataset([50, 8, 51]), task=TASK, seeds=seeds)
    assert report.evidence == "frames"
    assert [(one.episode, one.evaluation_seed) for one in report.shared] == [
        (f"episode {number}", 8) for number in found
    ]


def test_seeds_that_nothing_distinguishes_are_an_error_and_no_all_clear(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("vla_eval.data.sharing.leak.psnr_db", lambda one, other: 100.0)
    with pytest.raises(DatasetError, match="neither the arm's state nor the first frames distinguish"):
        check_leak(fake_dataset([50]), task=TASK, seeds=range(1, 4))


@pytest.mark.parametrize("text", ["100-1", "one", "-5"])
def test_seeds_that_are_none_are_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["dataset", "check-leak", "data/x", f"--seeds={text}"])
    assert "seed" in capsys.readouterr().err


def npz_episode(joints: np.ndarray) -> dict[str, Any]:
    n = 2
    return {
        "rgb": np.zeros((n, 128, 128, 6), dtype=np.uint8),
        "joints": np.stack([joints, joints]).astype(np.float32),
        "action": np.full((n, 7), -1, dtype=np.float32),
        "reward": np.zeros(n, dtype=np.float32),
        "success": np.zeros(n, dtype=bool),
        "done": np.zeros(n, dtype=bool),
    }


def test_in_the_simulator_the_arms_state_decides_for_npz_files_and_what_is_converted_from_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env = make_env(EnvSettings(task=TASK))
    begun = {
        seed: proprioception(env.reset({0: seed}, render=False)[0].observation.state)["joints"]
        for seed in (2, 777)
    }
    env.close()
    folder = tmp_path / "paper"
    folder.mkdir()
    np.savez(folder / "train_data_0.npz", **npz_episode(begun[777]))
    np.savez(folder / "train_data_1.npz", **npz_episode(begun[2]))
    convert_to_lerobot(
        find_source(folder), tmp_path / "ours", state="eef", changes=Changes(task=task_spec(TASK))
    )

    report = check_leak(read_initial_states(tmp_path / "ours"), task=TASK, seeds=range(1, 4))
    assert report.evidence == "state"
    assert [(one.episode, one.evaluation_seed) for one in report.shared] == [("episode 1", 2)]

    assert main(["dataset", "check-leak", str(folder), "--seeds", "1-3"]) == 1
    assert "names no task. Add --task" in capsys.readouterr().err
    words = ["dataset", "check-leak", str(folder), "--task", TASK, "--seeds"]
    assert main([*words, "1-3"]) == 1
    captured = capsys.readouterr()
    cells = [cell.strip() for cell in captured.out.splitlines()[-1].split("|")[1:-1]]
    assert cells == ["train_data_1.npz", "—", "2"]
    assert "1 of 2 demonstrations begin as an evaluation's episode does" in captured.err
    assert main([*words, "5"]) == 0
    assert f"2 episodes with seeds 5 to 5 of {TASK}, by the arm's initial state" in capsys.readouterr().out
