"""The dataset card says what the dataset says, the same way each time."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from huggingface_hub import DatasetCard
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

from tests.data.failed_episodes import let_fail
from vla_eval.cli.main import main
from vla_eval.data.dataset_folder import check_dataset
from vla_eval.data.foreign.changes import Changes
from vla_eval.data.foreign.convert import convert_to_lerobot, find_source
from vla_eval.data.opening import open_local_dataset
from vla_eval.data.sharing.card import CARD_FILE, SHEET_FILE, idle_actions, write_card
from vla_eval.errors import DatasetError
from vla_eval.tasks.catalog import task_spec
from vla_eval.testing.synthetic import write_synthetic_dataset
from vla_eval.viz.contact_sheet import EDGE_PX, LABEL_PX, LEFT_PX, MARGIN_PX, SheetRow, contact_sheet


def front_matter(text: str) -> dict[str, object]:
    _, matter, _ = text.split("---\n", 2)
    data: dict[str, object] = yaml.safe_load(matter)
    return data


def test_the_front_matter_is_what_the_hub_reads(recorded: Path) -> None:
    data = front_matter(write_card(recorded))

    assert data["license"] == "mit"
    assert data["task_categories"] == ["robotics"]
    assert "LeRobot" in data["tags"]  # type: ignore[operator]
    assert data["configs"] == [{"config_name": "default", "data_files": "data/*/*.parquet"}]


def test_the_hubs_own_class_reads_the_card_as_it_was_written(recorded: Path) -> None:
    text = write_card(recorded, license_id="cc-by-4.0")
    card = DatasetCard.load(recorded / CARD_FILE)

    assert card.data.license == "cc-by-4.0"
    assert card.data.to_dict() == front_matter(text)
    assert card.content == text
    assert card.text.startswith("\n# ")


def test_the_numbers_are_those_of_the_dataset(recorded: Path) -> None:
    text = write_card(recorded)

    # Lengths 13, 14, 15, 13: 55 frames, mean 13.75.
    assert "| frames | 55 |" in text
    assert "| frames per episode | 13 to 15, mean 13.8 |" in text
    assert "| episodes with success | 4 |" in text
    assert "| seeds | 1000 to 1004 |" in text
    assert "| seeds left out because the expert failed | 1: 1002 |" in text
    assert "| expert | oracle, version 1 |" in text
    dataset = open_local_dataset(recorded)
    gripper = np.array([dataset.hf_dataset[i]["action"][6].item() for i in range(55)])
    numbers = (gripper.mean(), gripper.std(), gripper.min(), gripper.max())
    assert f"| gripper | {' | '.join(f'{number:.4f}' for number in numbers)} |" in text
    assert "look, wait, choose" in text and "follow the ball" in text


def test_failures_that_were_kept_are_in_the_title_and_named(recorded: Path) -> None:
    text = write_card(let_fail(recorded, 1, 3))

    assert "# RememberColor3-v0: 4 episodes, 2 with success\n" in text
    assert "| episodes with success | 2 |" in text
    assert "| seeds kept although the expert failed | 2: 1001, 1004 |" in text
    assert "- Kept: all;" in text
    assert "RememberColor3-v0: 4 demonstrations" not in text


def test_hashes_and_recipe_are_there(recorded: Path) -> None:
    text = write_card(recorded)

    manifest = check_dataset(recorded).files["meta/mikasa/manifest.jsonl"].sha256
    assert f"| manifest sha256 | `{manifest}` |" in text
    assert f"| policies/oracle sha256 | `{'2' * 64}` |" in text
    assert "steps_after_success: 5" in text
    assert "| replay | not replayed yet" in text


def test_the_same_dataset_gives_the_same_card(recorded: Path) -> None:
    write_card(recorded)
    first = [(recorded / name).read_bytes() for name in (CARD_FILE, SHEET_FILE)]
    write_card(recorded)

    assert [(recorded / name).read_bytes() for name in (CARD_FILE, SHEET_FILE)] == first
    assert str(recorded.parent) not in first[0].decode()


def test_a_card_does_not_change_the_dataset(recorded: Path) -> None:
    before = check_dataset(recorded)
    write_card(recorded)

    assert check_dataset(recorded) == before
    assert isinstance(open_local_dataset(recorded), LeRobotDataset)


def test_the_sheet_shows_cue_delay_choice_and_end_of_three_episodes(recorded: Path) -> None:
    write_card(recorded)
    sheet = np.asarray(Image.open(recorded / SHEET_FILE))

    # Four pictures of the base camera and one of the wrist, 128 px each; episodes 0, 2 and 3.
    first, pitch = LABEL_PX + EDGE_PX + MARGIN_PX, 128 + MARGIN_PX
    assert sheet.shape == (first + 3 * pitch + MARGIN_PX, LEFT_PX + 5 * pitch + MARGIN_PX, 3)
    dataset = open_local_dataset(recorded)
    third = 13 + 14  # first frame of episode 2, which is 15 frames long
    for column, step in enumerate((0, 5, 10, 14)):
        seen = dataset[third + step]["observation.images.base"].numpy().transpose(1, 2, 0)
        left, top = LEFT_PX + column * pitch, first + pitch
        assert np.array_equal(
            sheet[top : top + 128, left : left + 128], (seen * 255).round().astype(np.uint8)
        )


def test_a_sheet_of_one_picture() -> None:
    red = np.full((16, 32, 3), (255, 0, 0), dtype=np.uint8)

    png = contact_sheet(["cue"], [SheetRow(name="", frames=(red,))])

    assert png.startswith(b"\x89PNG")
    assert png == contact_sheet(["cue"], [SheetRow(name="", frames=(red,))])


def imported(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    joints = rng.uniform(-1, 1, (6, 25))
    joints[:, 3:7] = 1, 0, 0, 0
    (tmp_path / "npz").mkdir()
    np.savez(
        tmp_path / "npz/train_data_0.npz",
        rgb=np.zeros((6, 128, 128, 6), np.uint8),
        joints=joints,
        action=rng.uniform(-1, 1, (6, 8)),
    )
    source = find_source(tmp_path / "npz")
    convert_to_lerobot(
        source, tmp_path / "ours", state="eef", changes=Changes(task=task_spec("RememberColor3-v0"))
    )
    return tmp_path / "ours"


def test_the_card_of_an_import_says_what_it_lacks(tmp_path: Path) -> None:
    text = write_card(imported(tmp_path))

    assert "license" not in front_matter(text)
    assert "| episodes with success | not stored |" in text
    assert "fields that the source does not have: next.reward, next.success, next.done" in text
    assert "**not executable by `pd_ee_delta_pose`**" in text
    assert "| joint1_delta |" in text
    assert "That of the source" in text


def test_dimensions_that_hardly_vary_are_named() -> None:
    stds = np.array([0.2, 0.0, 5e-4])
    assert idle_actions(("dx", "drx", "gripper"), stds) == ["drx", "gripper"]


def test_an_unfinished_dataset_gets_no_card(tmp_path: Path) -> None:
    root = write_synthetic_dataset(tmp_path / "unfinished", n_episodes=1, n_frames=2)

    with pytest.raises(DatasetError, match="not a complete dataset"):
        write_card(root)
    assert not (root / CARD_FILE).exists()


def test_a_damaged_dataset_gets_no_card(recorded: Path) -> None:
    (recorded / "meta/stats.json").write_text("{}")

    with pytest.raises(DatasetError, match=r"stats.json: expected \d+ bytes, found 2"):
        write_card(recorded)


def test_the_command_line(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "card", str(recorded), "--license", "cc-by-4.0"]) == 0

    assert "README.md" in capsys.readouterr().out
    assert front_matter((recorded / CARD_FILE).read_text())["license"] == "cc-by-4.0"
