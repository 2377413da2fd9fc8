"""Recording in the simulator: a small dataset replays to the bit, and colours survive the video."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data.replays import passed
from vla_eval.cli.main import main
from vla_eval.data.manifest import read_manifest
from vla_eval.data.opening import open_dataset, open_local_dataset
from vla_eval.data.recording import record as recording_module
from vla_eval.data.recording.shard_writer import new_dataset
from vla_eval.data.replaying import replay as replay_module
from vla_eval.features import (
    ACTION_NAMES,
    CAMERA_KEYS,
    STATE_NAMES,
    EncoderSettings,
    dataset_features,
    state_names,
)
from vla_eval.robots.rows import SO100
from vla_eval.tasks.interface import ACTION, CAMERAS, states
from vla_eval.tasks.remember import COLORS

TASK = "RememberColor3-v0"
HORIZON = 24
# Levels of 255, of the mean over a patch, in any channel. The nearest two of the nine colours, red and
# maroon, are 127 apart.
MAX_COLOUR_ERROR = 6.0


@pytest.fixture(autouse=True)
def _same_environment() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for module in (recording_module, replay_module):
            patch.setattr(module, "collect_environment", lambda: {"machine": "test"})
        yield


def test_recorded_episodes_replay_to_the_bit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--task", TASK, "--episodes", "2", "--workers", "1", "--out", str(tmp_path / "out")]
    for field in ("render.wrist_mesh=simplified", "cut=horizon", f"env.horizon_steps={HORIZON}"):
        arguments += ["--set", field]

    assert main(["record", *arguments]) == 0

    out = capsys.readouterr().out
    assert f"2 episodes, {2 * HORIZON} frames" in out
    assert "2 of 2 episodes replayed: as recorded" in out  # the check that training asks for
    dataset = tmp_path / "out" / TASK
    assert passed(dataset) is not None
    for episode in read_manifest(dataset):
        assert episode.n_steps == HORIZON
        assert (episode.cue_steps, episode.delay_steps) == (5, 5)
        # The expert holds still while the choice cannot be made, then moves, gripper open throughout.
        actions = episode.action_rows()
        assert np.array_equal(actions[:10, :6], np.zeros((10, 6)))
        assert actions[10, 2] < 0
    first = open_dataset(dataset).lerobot()[0]
    assert first["observation.state"][2].item() == pytest.approx(0.318, abs=0.05)  # the arm's rest height

    assert main(["replay", str(dataset), "--pixels", "--workers", "1"]) == 0

    report = passed(dataset)
    assert report is not None
    assert report.states_compared == "bit-equal"
    assert min(report.lowest_psnr_db.values()) > 36  # yuv420p would be below 34


def colour_frame(rgb: tuple[int, int, int]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return a frame with a patch of the colour, as small as a cube in the base camera, on a rough table."""
    frame = np.random.default_rng(0).normal((150, 140, 130), 8, (128, 128, 3)).clip(0, 255).astype(np.uint8)
    frame[60:68, 60:68] = rgb
    return frame


def test_all_nine_cue_colours_survive_the_video(tmp_path: Path) -> None:
    dataset = new_dataset(
        tmp_path / "colours", dataset_features("eef"), encoder=EncoderSettings(), max_frames=len(COLORS)
    )
    for color in COLORS:
        frame: dict[str, Any] = {
            key: np.zeros(spec["shape"], dtype=np.bool_ if spec["dtype"] == "bool" else np.float32)
            for key, spec in dataset_features("eef").items()
        }
        frame |= {key: colour_frame(color.rgb) for key in CAMERA_KEYS.values()}
        dataset.add_frame({**frame, "task": "remember"})
    dataset.save_episode()
    dataset.finalize()

    decoded = open_local_dataset(tmp_path / "colours", return_uint8=True)

    assert len(COLORS) == 9
    for index, color in enumerate(COLORS):
        for key in CAMERA_KEYS.values():
            patch = decoded[index][key][:, 61:67, 61:67].double().mean(dim=(1, 2)).numpy()
            assert np.abs(patch - color.rgb).max() <= MAX_COLOUR_ERROR, color.name


def test_names_of_dimensions_are_those_of_the_environment() -> None:
    assert ACTION.dims == ACTION_NAMES
    n_numbers = sum(len(spec.dims) for spec in states())
    assert n_numbers == len(STATE_NAMES["joints"]) == 25
    assert {camera.name for camera in CAMERAS} == set(CAMERA_KEYS)


@pytest.mark.slow  # three processes start
def test_a_recording_names_the_robot_and_its_joints_and_replays(tmp_path: Path) -> None:
    out = tmp_path / "demos"
    command = ["record", "--task", "ShellGameTouch-v0", "--set", "env.robot=so100", "--episodes", "1"]
    assert main([*command, "--workers", "1", "--out", str(out)]) == 0
    dataset = open_dataset(out / "ShellGameTouch-v0")
    assert dataset.meta.robot_type == "so100" and dataset.was_replayed
    features = dataset.meta.features
    joints = features["proprio.joints"]["names"]
    assert tuple(joints) == state_names(SO100)["joints"] and len(joints) == 19
    assert tuple(features["action"]["names"]) == SO100.actions["pd_joint_pos"].dims
