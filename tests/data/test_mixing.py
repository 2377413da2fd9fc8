"""`dataset mix`: one dataset of several, frame by frame theirs; those that do not fit are refused."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.data.second_task import SENTENCE, TASK, write_second_task
from vla_eval.cli.main import main
from vla_eval.config.finetuning import FinetuneRecipe, HeldOutConfig
from vla_eval.data.dataset_folder import check_complete
from vla_eval.data.derived.mixing import mix_datasets
from vla_eval.data.facts import find_facts, read_facts
from vla_eval.data.manifest import MIXTURE_FILE, RECORDING_FILE, REPLAY_FILE, ReplayReport, write_entry
from vla_eval.data.opening import open_local_dataset
from vla_eval.data.replay_report import manifest_sha256
from vla_eval.data.sharing.card import write_card
from vla_eval.data.tables import read_columns
from vla_eval.errors import DatasetError, RecipeError
from vla_eval.seeding import SeedRange
from vla_eval.training.dataset import training_dataset
from vla_eval.training.held_out import check_held_out

pytestmark = pytest.mark.usefixtures("no_network")


@pytest.fixture
def second(recorded: Path) -> Path:
    return write_second_task(recorded)


@pytest.fixture
def mixed(recorded: Path, second: Path, tmp_path: Path) -> Path:
    mix_datasets([recorded, second], tmp_path / "mixed")
    return tmp_path / "mixed"


def note_replay(root: Path) -> None:
    report = ReplayReport(
        passed=True,
        n_episodes=1,
        n_total=1,
        pixels=False,
        states_compared="bit-equal",
        mismatches=(),
        lowest_psnr_db={},
        manifest_sha256=manifest_sha256(root),
    )
    write_entry(root / REPLAY_FILE, report)


def test_a_frame_is_that_of_its_source_with_its_sentence(recorded: Path, second: Path, mixed: Path) -> None:
    whole = open_local_dataset(mixed)
    row = 0
    for source in (open_local_dataset(recorded), open_local_dataset(second)):
        for index in range(0, len(source), 5):
            expected, found = source[index], whole[row + index]
            for key in ("observation.images.base", "observation.images.wrist", "observation.state", "action"):
                assert torch.equal(expected[key], found[key]), (key, index)
            assert found["task"] == expected["task"]
        row += len(source)
    assert row == len(whole) == 55 + 27
    assert whole.meta.total_episodes == 4 + 2
    assert whole[row - 1]["task"] == SENTENCE


def test_statistics_are_those_of_all_frames(mixed: Path) -> None:
    statistics = open_local_dataset(mixed).meta.stats
    actions = read_columns(mixed)["action"].astype(np.float64)
    np.testing.assert_allclose(statistics["action"]["std"], actions.std(axis=0))
    np.testing.assert_allclose(statistics["action"]["q01"], np.quantile(actions, 0.01, axis=0))


def test_statistics_of_images_are_weighted_by_frames_and_have_no_quantiles(
    recorded: Path, second: Path, mixed: Path
) -> None:
    camera = "observation.images.base"
    one, other, all_ = (open_local_dataset(p).meta.stats[camera] for p in (recorded, second, mixed))
    np.testing.assert_array_equal(all_["max"], np.maximum(one["max"], other["max"]))
    n_one, n_other = (int(np.asarray(each["count"]).item()) for each in (one, other))
    np.testing.assert_allclose(
        all_["mean"], (n_one * one["mean"] + n_other * other["mean"]) / (n_one + n_other)
    )
    assert not any(name.startswith("q") for name in all_)


def test_it_is_complete_and_says_of_what_it_was_mixed(recorded: Path, second: Path, mixed: Path) -> None:
    facts = check_complete(mixed)
    assert facts == find_facts(mixed)
    mixture = find_facts(mixed)
    assert mixture is not None
    assert [one.task for one in mixture.sources] == ["RememberColor3-v0", TASK]
    assert [one.seeds for one in mixture.sources] == [(1000, 1001, 1003, 1004), (2000, 2001)]
    assert mixture.sources[0].failed_seeds == (1002,)
    assert mixture.sources[1].instructions == (SENTENCE,)
    one = training_dataset(recorded, allow_unreplayed=True)
    assert mixture.sources[0].sha256 == one.sha256


def test_a_changed_file_is_found(mixed: Path) -> None:
    path = next(mixed.glob("data/*/*.parquet"))
    path.write_bytes(b" " + path.read_bytes()[1:])
    with pytest.raises(DatasetError, match="its content is not what was mixed"):
        check_complete(mixed)


def test_a_mixture_was_replayed_only_if_all_of_it_was(recorded: Path, second: Path, tmp_path: Path) -> None:
    note_replay(recorded)
    assert not mix_datasets([recorded, second], tmp_path / "half").was_replayed
    with pytest.raises(DatasetError, match=f"{TASK} had not been replayed"):
        training_dataset(tmp_path / "half", allow_unreplayed=False)
    note_replay(second)
    mix_datasets([recorded, second], tmp_path / "whole")
    assert training_dataset(tmp_path / "whole", allow_unreplayed=False).was_replayed


def test_a_training_knows_all_its_tasks(mixed: Path) -> None:
    dataset = training_dataset(mixed, allow_unreplayed=True)
    assert (dataset.facts.task, dataset.facts.tasks) == (None, ("RememberColor3-v0", TASK))
    assert dataset.seeds == {
        "RememberColor3-v0": (SeedRange(first=1000, last=1001), SeedRange(first=1003, last=1004)),
        TASK: (SeedRange(first=2000, last=2001),),
    }


def test_an_evaluation_during_training_needs_one_of_the_tasks_and_seeds_of_none(mixed: Path) -> None:
    dataset = training_dataset(mixed, allow_unreplayed=True)
    recipe = FinetuneRecipe(type="act", steps=4, save_every_steps=2)
    with pytest.raises(RecipeError, match=r"is of RememberColor3-v0, ShellGameTouch-v0; say which"):
        check_held_out(HeldOutConfig(every_steps=2), recipe, dataset)
    assert check_held_out(HeldOutConfig(every_steps=2, task=TASK), recipe, dataset) == TASK
    with pytest.raises(RecipeError, match="were recorded from"):
        check_held_out(HeldOutConfig(every_steps=2, task=TASK, seed_start=2001), recipe, dataset)


class TestRefused:
    def test_other_states_are_both_named(self, recorded: Path, tmp_path: Path) -> None:
        other = write_second_task(recorded, state="joints")
        with pytest.raises(DatasetError, match="the state is eef in the first and joints in the second"):
            mix_datasets([recorded, other], tmp_path / "out")
        assert not (tmp_path / "out").exists()

    def test_other_control_modes_are_both_named(self, recorded: Path, second: Path, tmp_path: Path) -> None:
        facts = read_facts(second)
        recipe = {**facts.recipe, "env": {"control_mode": "pd_joint_pos"}}
        write_entry(second / RECORDING_FILE, dataclasses.replace(facts, recipe=recipe))
        with pytest.raises(DatasetError, match=r"control mode is pd_ee_delta_pose .* pd_joint_pos in"):
            mix_datasets([recorded, second], tmp_path / "out")

    def test_the_same_dataset_twice(self, recorded: Path, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match="are the same dataset"):
            mix_datasets([recorded, recorded], tmp_path / "out")

    def test_a_mixture_of_a_mixture(self, recorded: Path, mixed: Path, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match=f"a mixture itself, of RememberColor3-v0, {TASK}"):
            mix_datasets([recorded, mixed], tmp_path / "out")

    def test_an_existing_folder(self, recorded: Path, second: Path) -> None:
        with pytest.raises(DatasetError, match="exists already"):
            mix_datasets([recorded, second], second)

    @pytest.mark.parametrize("verb", [["replay"], ["dataset", "check-leak"]])
    def test_what_is_done_with_its_sources(
        self, mixed: Path, verb: list[str], capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main([*verb, str(mixed)]) == 1
        assert "mixed of several" in capsys.readouterr().err


def test_its_card_lists_the_sources(mixed: Path) -> None:
    text = write_card(mixed)
    assert "# 2 tasks of 2 datasets: 6 demonstrations" in text
    assert f"| {TASK} | {TASK} | 1 | 2 | 27 | 2000 to 2001 | no |" in text
    assert "license: mit" in text
    assert SENTENCE in text


def test_the_command_says_what_it_made(
    recorded: Path, second: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mixed"
    assert main(["dataset", "mix", str(recorded), str(second), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"{TASK}: 2 episodes, 27 frames" in said
    assert f"{out}: 2 tasks, 6 episodes, 82 frames" in said
    assert "not replayed: RememberColor3-v0" in said
    assert json.loads((out / MIXTURE_FILE).read_text())["complete"] is True


def test_sources_with_the_same_scenes_are_named(mixed: Path) -> None:
    facts = find_facts(mixed)
    assert facts is not None
    assert facts.shared_scenes == ()  # the same seeds, of two tasks
    first = dataclasses.replace(facts.sources[0], seeds=(1, 2, 3, 7))
    again = dataclasses.replace(first, name="again", seeds=(2, 3, 9))
    other_rules = dataclasses.replace(again, name="old", task_version=(first.task_version or 0) + 1)
    found = dataclasses.replace(facts, sources=(first, again, other_rules)).shared_scenes
    assert found == (
        f"{first.name} and again share 2 seeds of {first.task}, from 2 to 3: these scenes count twice.",
    )
