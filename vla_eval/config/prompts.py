"""The language instruction of a task, from `prompts/*.yaml`. Knows nothing of simulators or policies."""

from dataclasses import dataclass
from typing import Protocol

from vla_eval.config.files import Recipe, load_recipe
from vla_eval.errors import MissingInstructionError, did_you_mean

DEFAULT_PROMPT_SET = "paper"


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptRecipe:
    """`prompts/*.yaml`: the instructions of the tasks, under one name."""

    version: int  # raised when a sentence changes
    description: str
    source: str  # where the sentences come from
    instructions: dict[str, tuple[str, ...]]  # a task's key -> its sentence, then paraphrases of it


class Instructed(Protocol):
    """What has an instruction: a task, by its id and its key in the prompt sets."""

    @property
    def id(self) -> str:
        """The task id."""

    @property
    def instruction_key(self) -> str:
        """Under which key a prompt set has its sentences."""

    @property
    def instruction(self) -> str | None:
        """Its own sentence, for prompt sets that have none; empty: it has none; None for most tasks."""


def load_prompts(prompt_set: str = DEFAULT_PROMPT_SET) -> Recipe[PromptRecipe]:
    """Return a set of instructions by name or path; errors as `load_recipe`."""
    return load_recipe("prompts", prompt_set, PromptRecipe)


def sentences_of(prompts: Recipe[PromptRecipe], spec: Instructed) -> tuple[str, ...]:
    """Return a task's sentences in a set: the sentence, then its paraphrases; else the task's own sentence.

    One that is missing or empty raises `MissingInstructionError`.
    """
    sentences = prompts.value.instructions.get(spec.instruction_key, ())
    if not sentences and spec.instruction is not None:
        return (spec.instruction,)
    if not sentences or not all(sentence.strip() for sentence in sentences):
        known = sorted(prompts.value.instructions)
        raise MissingInstructionError(
            f"{prompts.path.name}: {spec.id} needs an instruction under the key '{spec.instruction_key}', "
            f"which is missing or empty.{did_you_mean(spec.instruction_key, known)} "
            f"It has: {', '.join(known) or 'none'}. Add the sentence to a copy of the file in ./prompts/ and "
            f"name that file in prompt_set."
        )
    return sentences


def instruction_for(spec: Instructed, prompt_set: str = DEFAULT_PROMPT_SET) -> str:
    """Return the sentence of a task, word for word as the set has it; errors as of these two."""
    return sentences_of(load_prompts(prompt_set), spec)[0]
