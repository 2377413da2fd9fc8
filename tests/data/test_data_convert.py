"""Conversion to and from the paper's layout, and import of the authors' releases: nothing is made up."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from vla_eval.cli.main import main
from vla_eval.data.facts import find_facts
from vla_eval.data.foreign.changes import Changes
from vla_eval.data.foreign.convert import convert_to_lerobot, convert_to_npz, find_source
from vla_eval.data.foreign.import_writer import eef_of_proprio
from vla_eval.data.foreign.npz_files import npz_files, read_npz
from vla_eval.data.manifest import RECORDING_FILE
from vla_eval.data.opening import open_local_dataset
from vla_eval.errors import DatasetError
from vla_eval.tasks.catalog import task_spec
from vla_eval.testing.synthetic import write_synthetic_dataset
from vla_eval.training.dataset import training_dataset

BASE, WRIST = "observation.images.base", "observation.images.wrist"
TASK = "RememberColor3-v0"
# prompts/paper.yaml, from the paper's appendix.
SENTENCE = "Remember the color of the cube and then pick the matching one"
N_FRAMES = (5, 3)
FOR_TASK = Changes(task=task_spec(TASK))


def smooth_picture(rng: np.random.Generator) -> np.ndarray:
    """Return (128, 128, 6): colours that change slowly, which a video keeps well."""
    ramp = np.linspace(0, 80, 128)[:, None, None] + np.linspace(0, 60, 128)[None, :, None]
    return (ramp + rng.integers(0, 110, 6)).astype(np.uint8)


def episode_arrays(index: int, n_action: int = 7) -> dict[str, Any]:
    rng = np.random.default_rng(index)
    n = N_FRAMES[index]
    joints = rng.uniform(-1, 1, (n, 25)).astype(np.float32)
    joints[:, 3:7] /= np.linalg.norm(joints[:, 3:7], axis=1, keepdims=True)
    return {
        "rgb": np.stack([smooth_picture(rng) for _ in range(n)]),
        "joints": joints,
        "action": rng.uniform(-1, 1, (n, n_action)).astype(np.float32),
        "reward": rng.random(n, dtype=np.float32),
        "success": np.arange(n) == n - 1,
        "done": np.arange(n) == n - 1,
    }


def write_npz(folder: Path, episodes: list[dict[str, Any]]) -> Path:
    folder.mkdir()
    for index, arrays in enumerate(episodes):
        np.savez(folder / f"train_data_{index}.npz", **arrays)
    return folder


def paper_folder(folder: Path, n_action: int = 7) -> Path:
    return write_npz(folder, [episode_arrays(index, n_action) for index in range(2)])


def official_vla_arrays(index: int) -> dict[str, Any]:
    arrays = episode_arrays(index)
    joints = arrays.pop("joints")
    arrays["proprio"] = joints[:, :7].copy()
    arrays |= {
        "language_instruction": "Observe the cube's color, wait, then touch the cube of the same color.",
        "episode_seed": 40 + index,
        "episode_length": N_FRAMES[index],
        "success": arrays["success"].astype(np.int32),
        "done": arrays["done"].astype(np.int32),
    }
    return arrays


def load(root: Path) -> LeRobotDataset:
    return open_local_dataset(root)


def test_the_papers_layout_there_and_back_keeps_every_number(tmp_path: Path) -> None:
    source = paper_folder(tmp_path / "paper")

    convert_to_lerobot(find_source(source), tmp_path / "ours", changes=FOR_TASK, state="eef")
    convert_to_npz(find_source(tmp_path / "ours"), tmp_path / "back")

    for index in range(2):
        before = np.load(source / f"train_data_{index}.npz", allow_pickle=False)
        after = np.load(tmp_path / "back" / f"train_data_{index}.npz", allow_pickle=False)
        assert sorted(after.files) == ["action", "done", "joints", "reward", "rgb", "success"]
        for name in ("joints", "action", "reward"):
            assert after[name].dtype == np.float32
            assert np.array_equal(after[name], before[name])
        for name in ("success", "done"):
            assert after[name].dtype == np.int32
            assert np.array_equal(after[name], before[name].astype(np.int32))
        # Pictures went through video (h264 yuv444p crf 12): about 40 dB, hence 3 levels on average at most.
        assert after["rgb"].shape == before["rgb"].shape and after["rgb"].dtype == np.uint8
        assert np.abs(after["rgb"].astype(int) - before["rgb"].astype(int)).mean() < 3


def test_base_and_wrist_are_not_swapped(tmp_path: Path) -> None:
    arrays = episode_arrays(0)
    arrays["rgb"][..., :3], arrays["rgb"][..., 3:] = (200, 40, 40), (40, 40, 200)  # base red, wrist blue
    source = write_npz(tmp_path / "paper", [arrays])

    convert_to_lerobot(find_source(source), tmp_path / "ours", changes=FOR_TASK, state="eef")

    sample = load(tmp_path / "ours")[0]
    assert sample[BASE][0].mean() > 0.7 > 0.3 > sample[BASE][2].mean()
    assert sample[WRIST][2].mean() > 0.7 > 0.3 > sample[WRIST][0].mean()


def test_what_the_papers_layout_lacks_comes_from_the_named_task(tmp_path: Path) -> None:
    source = find_source(paper_folder(tmp_path / "paper"))
    facts = convert_to_lerobot(source, tmp_path / "ours", changes=FOR_TASK, state="joints")

    dataset = load(tmp_path / "ours")
    sample = dataset[5]  # first frame of the second episode
    joints = episode_arrays(1)["joints"][0]
    assert sample["task"] == SENTENCE
    assert np.array_equal(sample["observation.state"].numpy(), joints)
    assert np.array_equal(sample["proprio.eef"][:3].numpy(), joints[:3])
    # The gap between the fingers is the sum of both finger joints, numbers 14 and 15 of the 25.
    assert sample["proprio.eef"][9] == pytest.approx(joints[14] + joints[15])
    assert (facts.instruction_source, facts.control_mode) == ("prompts/paper", "pd_ee_delta_pose")
    assert facts.executable_by_pd_ee_delta_pose
    assert facts.absent == ()
    assert [episode.success for episode in facts.episodes] == [True, True]
    assert [episode.source_seed for episode in facts.episodes] == [None, None]
    assert find_facts(tmp_path / "ours") == facts


def test_without_instruction_and_task_nothing_is_written(tmp_path: Path) -> None:
    source = find_source(paper_folder(tmp_path / "paper"))

    with pytest.raises(DatasetError, match=r"train_data_0.npz, frame 0: the language ins.*--task"):
        convert_to_lerobot(source, tmp_path / "ours", state="eef")
    assert [path.name for path in tmp_path.iterdir()] == ["paper"]


def test_joint_delta_actions_are_kept_and_flagged(tmp_path: Path) -> None:
    source = find_source(paper_folder(tmp_path / "paper", n_action=8))
    facts = convert_to_lerobot(source, tmp_path / "ours", changes=FOR_TASK, state="eef")

    dataset = load(tmp_path / "ours")
    assert np.array_equal(dataset[2]["action"].numpy(), episode_arrays(0, n_action=8)["action"][2])
    assert dataset.features["action"]["names"][0] == "joint1_delta"
    assert facts.control_mode == "pd_joint_delta_pos"
    assert not facts.executable_by_pd_ee_delta_pose


def test_the_official_vla_recordings_bring_their_own_instruction_and_seeds(tmp_path: Path) -> None:
    source = write_npz(tmp_path / "vla", [official_vla_arrays(index) for index in range(2)])

    facts = convert_to_lerobot(find_source(source), tmp_path / "ours", state="eef")

    sample = load(tmp_path / "ours")[0]
    proprio = official_vla_arrays(0)["proprio"][0]
    assert sample["task"].startswith("Observe the cube's color")
    assert np.array_equal(sample["proprio.xyz_rpy"].numpy(), proprio)
    assert facts.instruction_source == "source"
    assert facts.absent == ("proprio.joints",)
    assert facts.left_out == ("episode_length",)
    assert [episode.source_seed for episode in facts.episodes] == [40, 41]


def test_joints_that_a_source_does_not_have_are_an_error(tmp_path: Path) -> None:
    source = find_source(write_npz(tmp_path / "vla", [official_vla_arrays(0)]))

    with pytest.raises(
        DatasetError, match=r"has no joint velocities, so observation.state cannot be 'joints'"
    ):
        convert_to_lerobot(source, tmp_path / "a", state="joints")
    with pytest.raises(
        DatasetError, match="has no joints, which the paper's layout holds; nothing is made up"
    ):
        convert_to_npz(source, tmp_path / "b")
    assert [path.name for path in tmp_path.iterdir()] == ["vla"]


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (3.1, -0.2, 0.7), (-np.pi, 0.4, -2.0)])
def test_the_rotation_of_position_and_angles_is_that_of_the_elementary_rotations(
    angles: tuple[float, float, float],
) -> None:
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in angles)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    matrix = about_z @ about_y @ about_x

    state = eef_of_proprio(np.array([0.1, 0.2, 0.3, *angles, 0.08], dtype=np.float32))

    assert state[3:9] == pytest.approx(np.concatenate([matrix[:, 0], matrix[:, 1]]), abs=1e-6)
    assert [*state[:3], state[9]] == pytest.approx([0.1, 0.2, 0.3, 0.08])


OFFICIAL_CAMERAS = ("observation.image", "observation.wrist_image")
SUITE90_CAMERAS = ("observation.images.top", "observation.images.wrist")


def write_official_lerobot(root: Path, cameras: tuple[str, str] = OFFICIAL_CAMERAS) -> Path:
    base, wrist = cameras
    vector = {"dtype": "float32", "shape": (7,), "names": None}
    image = {"dtype": "video", "shape": (128, 128, 3), "names": ["height", "width", "channel"]}
    dataset = LeRobotDataset.create(
        "local/official",
        fps=20,
        root=root,
        streaming_encoding=True,
        features={
            base: image,
            wrist: image,
            "observation.state": vector,
            "action": vector,
        },
    )
    arrays = official_vla_arrays(0)
    for step in range(N_FRAMES[0]):
        dataset.add_frame(
            {
                base: arrays["rgb"][step, ..., :3],
                wrist: arrays["rgb"][step, ..., 3:],
                "observation.state": arrays["proprio"][step],
                "action": arrays["action"][step],
                "task": "touch the cube",
            }
        )
    dataset.save_episode()
    dataset.finalize()
    return root


def test_the_official_lerobot_release_gets_our_names_and_no_invented_fields(tmp_path: Path) -> None:
    source = find_source(write_official_lerobot(tmp_path / "official"))

    facts = convert_to_lerobot(source, tmp_path / "ours", state="eef")

    sample = load(tmp_path / "ours")[1]
    arrays = official_vla_arrays(0)
    assert sample["task"] == "touch the cube"
    assert np.array_equal(sample["action"].numpy(), arrays["action"][1])
    assert np.array_equal(sample["proprio.xyz_rpy"].numpy(), arrays["proprio"][1])
    assert {BASE, WRIST} <= sample.keys()
    assert facts.absent == ("proprio.joints", "next.reward", "next.success", "next.done")
    assert facts.episodes[0].success is None


def test_a_dataset_of_the_90_tasks_can_be_trained_on(tmp_path: Path) -> None:
    root = write_official_lerobot(tmp_path / "remember_color_3_vla_v0", SUITE90_CAMERAS)
    task = "mikasa_vla/RememberColor3-VLA-v0"
    assert json.loads((root / "meta/info.json").read_text())["codebase_version"] == "v3.0"

    convert_to_lerobot(
        find_source(root), tmp_path / "ours", changes=Changes(task=task_spec(task)), state="eef"
    )

    with pytest.raises(DatasetError, match="--allow-unreplayed"):
        training_dataset(tmp_path / "ours", allow_unreplayed=False)
    found = training_dataset(tmp_path / "ours", allow_unreplayed=True)
    facts = found.facts
    assert (facts.task, facts.control_mode, facts.state) == (task, "pd_ee_delta_pose", "eef")
    assert {BASE, WRIST} <= set(found.meta.features)
    assert load(tmp_path / "ours")[1]["task"] == "touch the cube"


def test_a_recorded_dataset_becomes_the_papers_layout(tmp_path: Path) -> None:
    ours = write_synthetic_dataset(tmp_path / "ours", n_episodes=2, n_frames=4)

    assert convert_to_npz(find_source(ours), tmp_path / "npz") == 2

    dataset = load(ours)
    arrays = np.load(tmp_path / "npz" / "train_data_1.npz", allow_pickle=False)
    second = [dataset[index] for index in range(4, 9)]
    assert np.array_equal(arrays["joints"], np.stack([s["proprio.joints"].numpy() for s in second]))
    for camera, part in ((BASE, arrays["rgb"][..., :3]), (WRIST, arrays["rgb"][..., 3:])):
        decoded = np.stack([(s[camera].numpy() * 255).round().transpose(1, 2, 0) for s in second])
        assert np.array_equal(part, decoded.astype(np.uint8))


def test_an_imported_dataset_has_exact_statistics(tmp_path: Path) -> None:
    source = find_source(paper_folder(tmp_path / "paper"))
    convert_to_lerobot(source, tmp_path / "ours", changes=FOR_TASK, state="eef")

    stats = json.loads((tmp_path / "ours/meta/stats.json").read_text())
    actions = np.concatenate([episode_arrays(index)["action"] for index in range(2)]).astype(np.float64)
    assert stats["action"]["q99"] == pytest.approx(np.quantile(actions, 0.99, axis=0))
    assert stats["action"]["mean"] == pytest.approx(actions.mean(axis=0))


class TestMistakes:
    def test_pickled_objects_are_never_loaded(self, tmp_path: Path) -> None:
        source = write_npz(tmp_path / "evil", [{**episode_arrays(0), "action": np.array([object()])}])

        with pytest.raises(DatasetError, match="holds Python objects, which could run any program"):
            find_source(source)

    def test_a_damaged_file(self, tmp_path: Path) -> None:
        (tmp_path / "train_data_0.npz").write_bytes(b"PK\x03\x04 half a file")

        with pytest.raises(DatasetError, match=r"train_data_0.npz: cannot be read"):
            find_source(tmp_path)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"rgb": np.zeros((5, 64, 64, 3), np.uint8)}, r"rgb is \(5, 64, 64, 3\), expected \(5, height"),
            ({"rgb": np.zeros((5, 64, 64, 6))}, r"rgb is \(5, 64, 64, 6\) float64, expected uint8"),
            ({"joints": np.zeros((4, 25))}, r"joints is \(4, 25\) float64, expected \(5, 25\)"),
            ({"action": np.zeros((5, 6))}, r"action is \(5, 6\), expected \(T, 7\) or \(T, 8\)"),
            ({"language_instruction": 3}, "expected one sentence"),
            ({"language_instruction": ["one", "two"]}, "expected one sentence, or one per frame"),
        ],
    )
    def test_wrong_shapes_and_values_say_what_was_expected(
        self, tmp_path: Path, change: dict[str, Any], message: str
    ) -> None:
        np.savez(tmp_path / "train_data_0.npz", **{**episode_arrays(0), **change})

        with pytest.raises(DatasetError, match=message):
            read_npz(tmp_path / "train_data_0.npz")

    def test_a_missing_array_gets_a_suggestion(self, tmp_path: Path) -> None:
        arrays = episode_arrays(0)
        arrays["actions"] = arrays.pop("action")
        np.savez(tmp_path / "train_data_0.npz", **arrays)

        with pytest.raises(DatasetError, match=r"no 'action'. Did you mean 'actions'"):
            read_npz(tmp_path / "train_data_0.npz")

    def test_an_empty_folder(self, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match=r"neither a LeRobotDataset .* nor \*.npz files"):
            find_source(tmp_path)

    def test_nothing_is_overwritten(self, tmp_path: Path) -> None:
        source = find_source(paper_folder(tmp_path / "paper"))

        with pytest.raises(DatasetError, match="exists already"):
            convert_to_lerobot(source, tmp_path / "paper", changes=FOR_TASK, state="eef")

    def test_episodes_of_two_kinds_do_not_become_one_dataset(self, tmp_path: Path) -> None:
        source = write_npz(tmp_path / "mixed", [episode_arrays(0), episode_arrays(1, n_action=8)])

        with pytest.raises(DatasetError, match=r"train_data_1.npz differs .* in action"):
            convert_to_lerobot(find_source(source), tmp_path / "ours", changes=FOR_TASK, state="eef")

    def test_our_own_recording_is_not_imported(self, tmp_path: Path) -> None:
        ours = write_synthetic_dataset(tmp_path / "ours", n_episodes=1, n_frames=2)
        (ours / RECORDING_FILE).parent.mkdir()
        (ours / RECORDING_FILE).touch()

        with pytest.raises(DatasetError, match="of this project already"):
            convert_to_lerobot(find_source(ours), tmp_path / "again", state="eef")


def test_files_are_read_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 9, 1):
        (tmp_path / f"train_data_{number}.npz").touch()

    assert [path.stem for path in npz_files(tmp_path)] == ["train_data_1", "train_data_9", "train_data_10"]


def test_the_command_line_says_what_the_source_lacks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_npz(tmp_path / "vla", [official_vla_arrays(0)])
    arguments = ["dataset", "convert", str(source), "--to", "lerobot", "--out", str(tmp_path / "ours")]

    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert "1 episodes, 5 frames, from npz_proprio" in out
    assert "the source has no: proprio.joints" in out
    assert main(arguments) == 1
    assert "exists already" in capsys.readouterr().err
