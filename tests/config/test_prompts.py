"""The instructions are the paper's, word for word."""

from pathlib import Path

import pytest

from vla_eval.config.prompts import instruction_for, load_prompts, sentences_of
from vla_eval.errors import MissingInstructionError, RecipeError
from vla_eval.tasks.catalog import TASKS, task_spec

OFFICIAL = load_prompts("official_vla").value.instructions
REMEMBER_COLOR = "Remember the color of the cube and then pick the matching one"


@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        ("RememberColor3-v0", REMEMBER_COLOR),
        ("RememberColor5-v0", REMEMBER_COLOR),
        ("RememberColor9-v0", REMEMBER_COLOR),
        ("ShellGameTouch-v0", "Memorize the position of the cup covering the ball, then pick that cup"),
        # The paper's text has the curly apostrophe, U+2019.
        (
            "InterceptMedium-v0",
            "Track the ball\u2019s movement, estimate its velocity, then aim the ball at the target",
        ),
    ],
)
def test_the_paper_s_sentences(task: str, sentence: str) -> None:
    assert instruction_for(task_spec(task)) == sentence


@pytest.mark.parametrize("prompts", ["paper", "paraphrased", "other_task", "no_content"])
def test_every_task_has_a_sentence_in_each_of_the_sets_for_all(prompts: str) -> None:
    assert all(instruction_for(spec, prompts) for spec in TASKS.values())


def test_a_paraphrase_says_it_in_other_words() -> None:
    for spec in TASKS.values():
        assert instruction_for(spec, "paraphrased") != instruction_for(spec)


def test_the_sentence_of_another_task_is_the_paper_s_of_another_family() -> None:
    of_sentence = {instruction_for(spec): spec for spec in TASKS.values()}
    for spec in TASKS.values():
        other = of_sentence[instruction_for(spec, "other_task")]
        assert other.entry_point.split(":")[0] != spec.entry_point.split(":")[0], spec.id
    assert {instruction_for(spec, "no_content") for spec in TASKS.values()} == {"Do the task"}


def test_the_later_official_wording_is_a_set_of_its_own() -> None:
    spoken = {task for task, spec in TASKS.items() if spec.instruction_key in OFFICIAL}
    assert instruction_for(task_spec("RememberColor9-v0"), "official_vla") == (
        "Observe the cube's color, wait, then touch the cube of the same color."
    )
    other = {task.split("-")[0].rstrip("3579") for task in TASKS if task not in spoken}
    assert other == {"BunchOfColors", "SeqOfColors", "ChainOfColors", "RememberObject"} | {
        f"Rotate{mode}{sign}" for mode in ("Lenient", "Strict") for sign in ("Pos", "PosNeg")
    }


def write(folder: Path, instructions: str) -> str:
    path = folder / "own.yaml"
    path.write_text(f"version: 1\ndescription: d\nsource: s\ninstructions: {instructions}\n")
    return str(path)


def test_paraphrases_follow_the_sentence(tmp_path: Path) -> None:
    prompts = write(tmp_path, "{RememberColor: [one, two]}")
    spec = task_spec("RememberColor3-v0")

    assert instruction_for(spec, prompts) == "one"
    assert sentences_of(load_prompts(prompts), spec) == ("one", "two")


@pytest.mark.parametrize(
    "instructions", ["{RememberColour: [a]}", "{RememberColor: []}", "{RememberColor: [' ']}"]
)
def test_a_missing_or_empty_instruction_is_an_error_that_says_what_to_do(
    tmp_path: Path, instructions: str
) -> None:
    with pytest.raises(
        MissingInstructionError, match=r"own\.yaml: RememberColor3-v0 .*'RememberColor'.*Add the sentence"
    ):
        instruction_for(task_spec("RememberColor3-v0"), write(tmp_path, instructions))


def test_a_sentence_instead_of_a_list_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"'instructions\.RememberColor': expected a list"):
        instruction_for(task_spec("RememberColor3-v0"), write(tmp_path, "{RememberColor: go}"))
