"""What a policy was trained with is compared fact by fact with what it is asked."""

import dataclasses
import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vla_eval.checkpoints.files import FACTS_FILE, TrainingFacts, read_facts, write_facts
from vla_eval.checkpoints.trained_with import (
    Asked,
    about_sentence,
    compared,
    differences,
    refuse_differences,
)
from vla_eval.control_modes import CONTROL_MODES
from vla_eval.errors import CheckpointError, SpecMismatchError
from vla_eval.models.shared.gripper import ENCODINGS, Gripper
from vla_eval.policies.lerobot.inputs import _gripper_problems
from vla_eval.tasks.interface import env_spec

COLOR, TOUCH = "RememberColor3-v0", "ShellGameTouch-v0"
SIZES = {"a": (128, 128), "b": (128, 128)}
ENV = env_spec()
FACTS = TrainingFacts(
    run="r",
    dataset="d",
    dataset_sha256="0" * 64,
    task=COLOR,
    state="eef",
    images=dict(SIZES),
    fps=ENV.control_hz,
    action_names=ENV.action.dims,
    control_mode=ENV.action.control_mode,
    run_seed=0,
    sentences={COLOR: ("lift it", "lift it, please")},
    gripper_open=ENV.action.gripper_open,
    robot=ENV.robot,
)
ASKED = Asked(ENV, SIZES, "eef")


def told(sentence: str, trained: dict[str, tuple[str, ...]] | None, task: str = COLOR) -> str | None:
    return about_sentence(trained, sentence, policy="p", task=task)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"control_mode": "pd_joint_pos"}, "control mode: expected pd_joint_pos, found pd_ee_delta_pose"),
        (
            {"robot": "so100"},
            "robot: expected so100, found panda_wristcam. Evaluate it with --set env.robot=so100",
        ),
        ({"gripper_open": -1.0}, "the gripper's number that opens it: expected -1.0, found 1.0"),
        ({"fps": 10.0}, "control steps per second: expected 10.0, found 20.0"),
        ({"state": "joints"}, "state: expected joints, found eef"),
        ({"images": {"a": (128, 128), "b": (96, 128)}}, "size of b: expected (96, 128), found (128, 128)"),
        ({"images": {"b": (128, 128), "a": (128, 128)}}, "images and their order: expected ('b', 'a')"),
        ({"action_names": ("x",)}, "action dimensions: expected ('x',)"),
    ],
)
def test_each_fact_that_differs_is_one_line_with_both_values_and_what_to_do(
    change: dict[str, Any], said: str
) -> None:
    (line,) = differences(dataclasses.replace(FACTS, **change), ASKED)
    assert line.startswith(said)
    assert line.rpartition(". ")[2].endswith(".")
    with pytest.raises(SpecMismatchError, match=r"policy 'p' would not be given on t what it was trained"):
        refuse_differences([line], policy="p", task="t")


def test_every_row_is_shown_to_differ_above() -> None:
    names = {row.what for row in compared(FACTS, ASKED)}
    assert names == {
        *("robot", "control mode", "action dimensions", "the gripper's number that opens it"),
        *("control steps per second", "images and their order", "size of a", "size of b", "state"),
    }
    assert differences(FACTS, ASKED) == []


@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_a_policy_of_any_control_mode_is_asked_for_that_one_alone(mode: str) -> None:
    own = env_spec(control_mode=mode)
    facts = dataclasses.replace(FACTS, control_mode=mode, action_names=own.action.dims)
    assert differences(facts, Asked(own, SIZES, "eef")) == []
    for other in set(CONTROL_MODES) - {mode}:
        lines = differences(facts, Asked(env_spec(control_mode=other), SIZES, "eef"))
        assert lines[0] == (
            f"control mode: expected {mode}, found {other}. Evaluate it with --set env.control_mode={mode}."
        )


def test_what_is_not_known_is_not_compared() -> None:
    assert differences(None, ASKED) == []
    assert differences(dataclasses.replace(FACTS, gripper_open=None, robot=None), ASKED) == []
    assert differences(FACTS, Asked(ENV)) == []


@pytest.mark.parametrize("sentence", ["lift it", "lift it, please"])
def test_a_sentence_of_the_demonstrations_is_fine(sentence: str) -> None:
    assert told(sentence, FACTS.sentences) is None


@pytest.mark.parametrize("sentence", ["Lift it", "lift it ", "lift", "lift it.", "lift it, pleas", ""])
def test_every_other_sentence_is_named_beside_those_that_were_trained(sentence: str) -> None:
    line = told(sentence, FACTS.sentences)
    assert line is not None
    assert line.startswith(f"policy 'p' is asked on {COLOR} with a sentence that it was never trained with: ")
    assert f"{sentence!r}. Those of its training ({COLOR}): 'lift it', 'lift it, please'." in line
    assert "prompt_set" in line


def test_the_sentence_of_another_task_is_not_this_ones() -> None:
    both = {COLOR: ("lift it",), TOUCH: ("touch it",)}
    assert told("touch it", both, TOUCH) is None
    line = told("lift it", both, TOUCH)
    assert line is not None and f"its training ({TOUCH}): 'touch it'." in line


def test_a_task_that_was_not_trained_may_be_asked_with_any_trained_sentence() -> None:
    assert told("lift it", {COLOR: ("lift it",)}, TOUCH) is None
    assert told("lift it", {"": ("lift it",)}, TOUCH) is None
    line = told("touch it", {COLOR: ("lift it",)}, TOUCH)
    assert line is not None and f"its training ({COLOR}): 'lift it'." in line


def test_words_that_differ_per_episode_stand_for_any() -> None:
    trained = {COLOR: ("turn it by 44 degrees (left)", "turn it by 9 degrees (left)")}
    assert told("turn it by {angle_deg} degrees (left)", trained) is None
    assert told("turn it by {angle_deg} degrees (right)", trained) is not None


def test_nothing_is_said_where_nothing_is_known() -> None:
    assert told("x", None) is None
    assert told("x", {}) is None


def test_facts_of_earlier_versions_are_read_and_have_no_sentences(tmp_path: Path) -> None:
    write_facts(tmp_path, dataclasses.replace(FACTS, sentences=None, gripper_open=None))
    text = (tmp_path / FACTS_FILE).read_text()
    older = text.replace(',\n  "sentences": null,\n  "gripper_open": null', "")
    assert older != text
    (tmp_path / FACTS_FILE).write_text(older)
    facts = read_facts(tmp_path)
    assert facts is not None and (facts.sentences, facts.gripper_open) == (None, None)


@pytest.mark.parametrize("damaged", ['"lift it"', "[1]", '{"t": "lift it"}', '{"t": [1]}', "7"])
def test_sentences_of_another_form_are_refused(damaged: str, tmp_path: Path) -> None:
    write_facts(tmp_path, dataclasses.replace(FACTS, sentences=None))
    text = (tmp_path / FACTS_FILE).read_text()
    (tmp_path / FACTS_FILE).write_text(text.replace('"sentences": null', f'"sentences": {damaged}'))
    with pytest.raises(CheckpointError, match="sentences"):
        read_facts(tmp_path)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write_facts(tmp_path, FACTS)
    assert read_facts(tmp_path) == FACTS


def test_a_gripper_that_is_decoded_otherwise_than_it_was_encoded_is_a_problem() -> None:
    def loaded(before: Gripper, behind: Gripper) -> Any:
        steps = {"preprocessor": [SimpleNamespace(), SimpleNamespace(gripper=before)]}
        steps["postprocessor"] = [SimpleNamespace(gripper=behind)]
        return SimpleNamespace(**{name: SimpleNamespace(steps=own) for name, own in steps.items()})

    every = [Gripper(encoding=encoding) for encoding in ENCODINGS]
    for before, behind in itertools.product([*every, Gripper(decoding="binary")], repeat=2):
        problems = _gripper_problems(loaded(before, behind))
        assert len(problems) == (before != behind)
        assert all(repr(before) in line and repr(behind) in line for line in problems)
