"""What is converted on request, and what is refused without: values that are computed here by hand."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vla_eval.cli.main import main
from vla_eval.data.checks.rules import RULES
from vla_eval.data.facts import find_facts
from vla_eval.data.foreign.changes import Changes, prepare
from vla_eval.data.foreign.convert import convert_to_lerobot, find_source
from vla_eval.data.opening import open_local_dataset
from vla_eval.errors import DatasetError, RecipeError
from vla_eval.tasks.catalog import task_spec

TASK = task_spec("RememberColor3-v0")
SENTENCE = "pick the red cube"
ROOT = Path(__file__).parents[2]


def episode(n: int, **changes: Any) -> dict[str, Any]:
    joints = np.zeros((n, 25), np.float32)
    joints[:, 3:7] = 1, 0, 0, 0
    rng = np.random.default_rng(n)
    joints[:, 0] = rng.uniform(-0.5, 0.5, n)
    arrays = {
        "rgb": np.full((n, 128, 128, 6), 90, np.uint8),
        "joints": joints,
        "action": rng.uniform(-0.9, 0.9, (n, 7)).astype(np.float32),
        "reward": np.zeros(n, np.float32),
        "success": np.zeros(n, bool),
        "language_instruction": SENTENCE,
    }
    return {**arrays, **changes}


def folder(root: Path, *episodes: dict[str, Any]) -> Path:
    root.mkdir()
    for number, arrays in enumerate(episodes):
        np.savez(root / f"train_data_{number}.npz", **arrays)
    return root


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda n: {"joints": np.zeros((n, 25), np.float32)}, "quaternion of proprio.joints is of length 0"),
        (
            lambda n: {"joints": np.eye(25, dtype=np.float32)[[3] * (n - 1) + [0]]},
            "train_data_1.npz, frame 3: the quaternion",
        ),
        (lambda n: {"action": np.full((n, 7), np.nan, np.float32)}, "frame 0: action (dx) is nan"),
        (lambda n: {"action": np.full((n, 7), 1e30)}, "the bounds of pd_ee_delta_pose"),
        (lambda n: {"success": np.full(n, 0.5)}, "next.success is 0.5, expected 0 or 1"),
        (lambda n: {"reward": np.full(n, np.inf)}, "next.reward is inf, expected a finite number"),
        (lambda n: {"language_instruction": " "}, "is ' ', expected a sentence"),
        (
            lambda n: {"language_instruction": [SENTENCE] * (n - 1) + ["x"]},
            "expected one sentence per episode",
        ),
        (
            lambda n: {"rgb": np.zeros((n, 96, 128, 6), np.uint8)},
            "96 × 128 (height × width, px), expected 128",
        ),
        (lambda n: {"rgb": np.zeros((n, 256, 256, 6), np.uint8)}, "--image-size PX"),
    ],
)
def test_a_second_episode_that_breaks_a_rule_stops_the_import_before_anything_is_written(
    tmp_path: Path, change: Any, words: str
) -> None:
    root = folder(tmp_path / "npz", episode(5), episode(4, **change(4)))
    with pytest.raises(DatasetError) as caught:
        convert_to_lerobot(find_source(root), tmp_path / "ours", state="eef")
    assert words in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["npz"]


@pytest.mark.parametrize("lengths", [(0, 5), (5, 0), (1, 5), (5, 1), (0, 0)])
def test_episodes_without_two_frames_are_refused_by_name(tmp_path: Path, lengths: tuple[int, ...]) -> None:
    root = folder(tmp_path / "npz", *(episode(n) for n in lengths))
    short = next(number for number, n in enumerate(lengths) if n < 2)
    with pytest.raises(DatasetError, match=f"train_data_{short}.npz has {lengths[short]} frames"):
        convert_to_lerobot(find_source(root), tmp_path / "ours", state="eef")


def resampled(tmp_path: Path, fps: int, **arrays: Any) -> tuple[Any, tuple[str, ...]]:
    """Return the episode at 20 frames per second of one at another rate."""
    source = find_source(folder(tmp_path / "npz", arrays))
    object.__setattr__(source, "fps", fps)  # npz files name no rate
    changed, converted, _ = prepare(source, Changes(resample=True))
    return changed.episodes[0], converted


def test_frames_of_10_hz_are_shown_twice_and_each_moves_half_as_far(tmp_path: Path) -> None:
    arrays = episode(3, success=np.array([0, 0, 1]))
    changed, converted = resampled(tmp_path, 10, **arrays)

    twice = arrays["action"].repeat(2, axis=0)
    np.testing.assert_allclose(changed.numbers["action"][:, :6], twice[:, :6] / 2, atol=1e-6)
    assert np.array_equal(changed.numbers["action"][:, 6], twice[:, 6])  # a width, not a movement
    assert np.array_equal(changed.numbers["proprio.joints"], arrays["joints"].repeat(2, axis=0))
    assert changed.numbers["next.success"].tolist() == [False, False, False, False, True, True]
    assert changed.read_images()[0].shape == (6, 128, 128, 3)
    assert converted[0].startswith("frame rate: 10 to 20 frames per second, 3 frames to 6")


def test_frames_of_30_hz_move_as_far_in_two_steps_as_before_in_three(tmp_path: Path) -> None:
    actions = np.full((4, 7), 0.1, np.float32)
    actions[:, 0] = 0.1, 0.2, 0.3, 0.4
    arrays = episode(4, action=actions, done=np.array([0, 0, 0, 1]))
    changed, _ = resampled(tmp_path, 30, **arrays)

    # Step 0 takes frames 0 to 1.5, step 1 those to 3, step 2 the last one alone.
    np.testing.assert_allclose(changed.numbers["action"][:, 0], [0.1 + 0.1, 0.1 + 0.3, 0.4], atol=1e-6)
    assert changed.numbers["proprio.joints"][:, 0].tolist() == arrays["joints"][[0, 1, 3], 0].tolist()
    assert changed.numbers["next.done"].tolist() == [False, False, True]


@pytest.mark.parametrize("fps", [7, 10, 15, 24, 30, 50, 100])
def test_no_movement_is_lost_at_any_rate(tmp_path: Path, fps: int) -> None:
    arrays = episode(11, action=np.random.default_rng(fps).uniform(-0.1, 0.1, (11, 7)).astype(np.float32))
    changed, _ = resampled(tmp_path, fps, **arrays)
    moved = changed.numbers["action"][:, :6].sum(axis=0)
    np.testing.assert_allclose(moved, arrays["action"][:, :6].sum(axis=0), atol=1e-5)
    assert changed.n_frames == int(np.ceil(11 * 20 / fps))


def test_images_are_scaled_by_the_mean_of_the_pixels_that_become_one(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (3, 256, 256, 6)).astype(np.uint8)
    source = find_source(folder(tmp_path / "npz", episode(3, rgb=rgb)))

    changed, converted, _ = prepare(source, Changes(image_size_px=128))
    kept, unconverted, _ = prepare(source, Changes(image_size_px=256))

    wrist = changed.episodes[0].read_images()[1]
    means = rgb[..., 3:].reshape(3, 128, 2, 128, 2, 3).astype(float).mean(axis=(2, 4))
    assert np.abs(wrist - means).max() <= 1  # rounded once per direction
    assert converted == ("images: 256 × 256 to 128 × 128, by area",)
    assert np.array_equal(kept.episodes[0].read_images()[1], rgb[..., 3:])
    assert unconverted == ()


def test_what_was_converted_and_kept_is_said_and_stays_with_the_dataset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    actions = episode(5)["action"].astype(np.float64) * 2
    actions[:, 6] = 0, 1, 1, 0, 0
    root = folder(tmp_path / "npz", episode(5, action=actions, torque=np.ones(5)))
    arguments = ["dataset", "convert", str(root), "--to", "lerobot", "--out", str(tmp_path / "ours")]

    assert main([*arguments, "--task", TASK.id, "--gripper", "0", "1", "--clip-actions"]) == 0

    said = capsys.readouterr().out
    facts = find_facts(tmp_path / "ours")
    assert facts is not None and facts.is_checked and facts.left_out == ("torque",)
    assert [one.split(":")[0] for one in facts.converted] == ["gripper", "actions"]
    assert "'pick the red cube' is not the one with which RememberColor3-v0 is evaluated" in facts.kept[0]
    assert all(sentence in said for sentence in (*facts.converted, *facts.kept))
    stored = np.stack([open_local_dataset(tmp_path / "ours")[row]["action"].numpy() for row in range(5)])
    assert stored[:, 6].tolist() == [-1, 1, 1, -1, -1]
    np.testing.assert_allclose(stored[:, :6], actions[:, :6].clip(-1, 1), atol=1e-6)


@pytest.mark.parametrize(
    "asked", [{"image_size_px": 0}, {"image_size_px": 10**6}, {"gripper": (1, 1)}, {"gripper": (0, np.nan)}]
)
def test_changes_out_of_range_are_refused(asked: dict[str, Any]) -> None:
    with pytest.raises(RecipeError, match="expected"):
        Changes(**asked)


def test_the_docs_have_the_table_of_answers() -> None:
    text = (ROOT / "docs/datasets.md").read_text(encoding="utf-8")
    for rule in RULES:
        assert f"| {rule.name} | {rule.answer} |" in text, rule.name
