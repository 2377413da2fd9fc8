"""Demonstrations on an arm that another program recorded: what the door says of them, and what it refuses."""

import dataclasses
from pathlib import Path

import pytest

from tests.data.arm_datasets import MOTORS, NAMES, write_so101
from vla_eval.config.finetuning import FinetuneConfig, HeldOutConfig
from vla_eval.data.adopt import adopt
from vla_eval.data.check import check
from vla_eval.data.derived.mixing import mix_datasets
from vla_eval.data.opening import open_dataset
from vla_eval.data.sharing.card import write_card
from vla_eval.errors import DatasetError, RecipeError
from vla_eval.tasks.real_stages import COLORS, STAGES, told_by
from vla_eval.training.job import training_job

CONFIG = FinetuneConfig(
    policy="act", dataset="", device="cpu", finetune={"policy": {"chunk_size": 2, "n_action_steps": 2}}
)


@pytest.fixture(scope="module")
def so101(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_so101(tmp_path_factory.mktemp("so101") / "data")


def test_check_says_what_it_lacks_and_what_its_sentences_tell(so101: Path) -> None:
    report = check(so101)
    assert not report.is_refused and report.next_step == f"mikasa-vla dataset adopt {so101}"
    said = " ".join(one.sentence for one in report.said)
    for words in (
        "no phases",
        "use_degrees",
        "'Pick the red cube': CubeVisible, red",
        "'Pick the blue cube.': CubeVisible, blue",
    ):
        assert words in said


def test_adopted_it_is_trained_on_with_its_own_rate_and_cameras(tmp_path: Path) -> None:
    root = write_so101(tmp_path / "data")
    facts = adopt(root, task=None)
    assert (facts.control_mode, facts.state, facts.absent) == (
        *("motors", "motors"),
        ("next.success", "next.done"),
    )
    assert any("no phases" in sentence for sentence in facts.kept)
    job = training_job(dataclasses.replace(CONFIG, dataset=str(root), out=str(tmp_path / "run")))
    trained = job.facts
    assert (trained.fps, trained.control_mode, trained.action_names) == (30.0, "motors", NAMES)
    assert trained.images == {"observation.images.front": (48, 64), "observation.images.wrist": (32, 64)}
    assert trained.gripper_open is None and trained.robot is None
    assert set(job.policy.input_features) == {*trained.images, "observation.state"}
    held_out = HeldOutConfig(every_steps=20000)
    with pytest.raises(RecipeError, match="mikasa-vla real"):
        training_job(dataclasses.replace(CONFIG, dataset=str(root), held_out=held_out))


def test_two_of_one_arm_are_mixed_at_their_own_rate(tmp_path: Path) -> None:
    roots = [
        write_so101(tmp_path / color, sentences=[f"Pick the {color} cube"], seed=seed)
        for seed, color in enumerate(("red", "green"))
    ]
    for root in roots:
        adopt(root, task=None)
    mix_datasets(roots, tmp_path / "both")
    assert check(tmp_path / "both").said == ()
    job = training_job(dataclasses.replace(CONFIG, dataset=str(tmp_path / "both"), out=str(tmp_path / "run")))
    assert (job.facts.fps, job.facts.control_mode) == (30.0, "motors")
    assert open_dataset(tmp_path / "both").cameras == tuple(job.facts.images)


@pytest.mark.parametrize(
    "names",
    [
        {"names": [f"main_{motor}" for motor in MOTORS]},  # of LeRobot's old versions
        {"action_names": NAMES[::-1]},
        {"action_names": NAMES[:-1]},
    ],
)
def test_other_names_are_no_arms(names: dict[str, list[str]], tmp_path: Path) -> None:
    root = write_so101(tmp_path / "data", sentences=["Pick the red cube"], **names)
    assert check(root).is_refused
    with pytest.raises(DatasetError, match="fields are not those of this project"):
        adopt(root, task=None)


def test_a_card_is_refused_in_words(tmp_path: Path) -> None:
    root = write_so101(tmp_path / "data", sentences=["Pick the red cube"])
    adopt(root, task=None)
    with pytest.raises(DatasetError, match="no card for these yet"):
        write_card(root)


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
@pytest.mark.parametrize("color", COLORS)
def test_a_sentence_tells_its_stages_and_its_color(stage: object, color: str) -> None:
    (stage,) = [one for one in STAGES if one is stage]
    sentence = stage.instruction.format(color=color)
    names_color = color in sentence
    for written in (sentence, sentence.upper(), f"  {sentence}. "):
        told = told_by(written)
        assert stage in told.stages and told.color == (color if names_color else None)
    assert len(told.stages) == (1 if names_color else 2)  # the second and the third stage have one sentence
    assert told_by(f"{sentence} now") == ((), None)
