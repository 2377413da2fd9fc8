"""Find, read strictly and hash the YAML recipes; turn them into frozen dataclasses.

A recipe is a file in one of four folders: `configs/`, `policies/`, `prompts/`, `datasets/`. It is
found by a given path, then in the working directory's folder, then among the ones that come with the
package. Knows nothing of tasks, policies or simulators: whether a named task exists is not its affair.
"""

import dataclasses
import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from vla_eval.bounds import (
    MAX_EPISODES,
    MAX_PROCESSES,
    MAX_SECONDS,
    MAX_SLOTS,
    MAX_STEPS,
    check_bounds,
    check_seeds,
)
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.capture import RecordingConfig
from vla_eval.config.decoding import decode, set_field
from vla_eval.config.environment import RenderSettings, SimBackend, Simulator
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.config.shipped import search_folders
from vla_eval.config.yaml_data import MAX_CHARACTERS, load_yaml
from vla_eval.errors import MAX_SHOWN, RecipeError, unknown_name

Folder = Literal["configs", "policies", "prompts", "datasets"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe[T]:
    """A recipe and where it came from.

    Attributes:
        name: the file's name without `.yaml`.
        path: the file.
        sha256: digest of the file's bytes.
        value: what it says.
    """

    name: str
    path: Path
    sha256: str
    value: T


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyRecipe:
    """`policies/*.yaml`: which code and which weights, under one name.

    Attributes:
        version: raised when a change of the recipe moves a success rate.
        description: one sentence.
        adapter: a name from the registry (`mikasa-vla list policies`) or `module:attr`.
        args: keyword arguments of the adapter.
        default_n_action_steps: actions executed per inference, where the evaluation names none.
        max_workers: how many workers `workers: auto` may start, since each loads the policy.
        needs_candidates: the policy makes no sense for a task without candidates; such a pair is left out.
        finetune: how weights for it are trained; None for policies that have nothing to train.
    """

    version: int
    description: str
    adapter: str
    args: dict[str, Any] = field(default_factory=dict)  # Any: whatever the adapter takes
    default_n_action_steps: int = 1
    max_workers: int | None = None
    needs_candidates: bool = False
    finetune: FinetuneRecipe | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_bounds(self, {"default_n_action_steps": (1, MAX_STEPS), "max_workers": (1, MAX_PROCESSES)})


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptRecipe:
    """`prompts/*.yaml`: the instructions of the tasks, under one name.

    Attributes:
        version: raised when a sentence changes.
        description: one sentence.
        source: where the sentences come from.
        instructions: instruction key of a task -> its sentence, then paraphrases of it.
    """

    version: int
    description: str
    source: str
    instructions: dict[str, tuple[str, ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkingConfig:
    """How chunks of actions are executed; `vla_eval.chunking` explains it."""

    mode: Literal["receding_horizon", "temporal_ensemble"] = "receding_horizon"
    delay_steps: int = 0
    delay_alignment: Literal["skip", "stale"] = "skip"
    ensemble_decay: float = 0.01

    def spec(self, n_action_steps: int) -> ChunkingSpec:
        """Return the chunking of one evaluation."""
        return ChunkingSpec(n_action_steps=n_action_steps, **dataclasses.asdict(self))


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeoutConfig:
    """Seconds after which a worker that is busy with one thing is killed."""

    setup_seconds: float = 900.0
    reset_seconds: float = 120.0
    step_seconds: float = 120.0
    inference_seconds: float = 300.0

    def __post_init__(self) -> None:
        """Check the ranges."""
        least_and_most = (0.001, MAX_SECONDS)
        check_bounds(self, {f.name: least_and_most for f in dataclasses.fields(self)}, prefix="timeouts.")


@dataclass(frozen=True, slots=True, kw_only=True)
class EvalConfig:
    """`configs/*.yaml`: one evaluation. `docs/evaluation.md` has the table of all keys.

    Raises:
        RecipeError: a value out of its range, or something named twice.
    """

    name: str
    tasks: tuple[str, ...]
    policies: tuple[str, ...]
    description: str = ""
    n_action_steps: tuple[int, ...] | None = None
    episodes: int = 100
    seed_start: int = 1
    runs: int = 1
    prompt_set: str = "paper"
    env: dict[str, Any] = field(default_factory=dict)  # Any: the task checks its arguments
    chunking: ChunkingConfig = field(default_factory=ChunkingConfig)
    render: RenderSettings = field(default_factory=RenderSettings)
    simulator: Simulator = "maniskill"
    sim_backend: SimBackend = "cpu"
    stop_at_success: bool = False
    eager_rendering: bool = False
    slots_per_worker: int = 1
    workers: int | Literal["auto"] = "auto"
    timeouts: TimeoutConfig = field(default_factory=TimeoutConfig)
    max_consecutive_errors: int = 10
    recording: RecordingConfig = field(default_factory=RecordingConfig)

    def __post_init__(self) -> None:
        """Check what a type cannot say."""
        check_run_name(self.name)
        check_bounds(
            self,
            {
                "episodes": (1, MAX_EPISODES),
                "runs": (1, MAX_EPISODES),
                "slots_per_worker": (1, MAX_SLOTS),
                "max_consecutive_errors": (1, MAX_EPISODES),
                "workers": (1, MAX_PROCESSES),
            },
        )
        check_seeds(self.seed_start, self.episodes)
        for name in ("tasks", "policies", "n_action_steps"):
            values = getattr(self, name)
            _require(values is None or len(values) > 0, name, values, "at least one")
            _require(
                values is None or len(set(values)) == len(values), name, list(values or ()), "no doubles"
            )
        for n_action_steps in self.n_action_steps or (1,):
            self.chunking.spec(n_action_steps)  # checks the ranges


OPTION_FIELDS = ("name", "description", "workers", "timeouts", "max_consecutive_errors", "recording")
"""Fields of `EvalConfig` that move no result: they may differ when a run is continued."""


def _require(condition: bool, name: str, found: object, expected: str) -> None:
    if not condition:
        raise RecipeError(f"{name} is {found!s:.200}, expected {expected}.")


def check_run_name(name: str) -> None:
    """Raise `RecipeError` unless the name can be the name of a folder on any machine."""
    allowed = name and name[0].isalnum() and all(c.isalnum() or c in "._-" for c in name) and name.isascii()
    _require(bool(allowed), "name", repr(name), "letters, digits, '.', '_' and '-', a letter or digit first")


def check_recorded_name(name: str, *, kind: str) -> None:
    """Raise `RecipeError` unless tables, paths and spreadsheets can hold a recipe's name as it is."""
    if not (name.isprintable() and (name[:1].isalnum() or name[:1] == "_")):
        raise RecipeError(
            f"{kind}: the file is called {name!r:.200}, expected a name that begins with a letter, a digit "
            f"or '_' and has no line breaks or other control characters. Rename the file."
        )


# ------------------------------------------------------------------------------------------ finding


def list_recipes(folder: Folder) -> dict[str, Path]:
    """Return name -> file of all recipes of a kind; the working directory's hide the package's."""
    found: dict[str, Path] = {}
    for place in reversed(search_folders(folder)):
        found.update({path.stem: path for path in sorted(place.glob("*.yaml"))})
    return dict(sorted(found.items()))


def find_recipe(folder: Folder, name: str) -> Path:
    """Return the file of a recipe.

    Args:
        folder: the kind of recipe.
        name: a path, or the name of a recipe, with or without `.yaml`.

    Raises:
        UnknownNameError: there is no such file; the message names what there is.
    """
    as_path = Path(name)
    # os.path, unlike Path, says no to what cannot be a path at all: too long, or with a NUL.
    if as_path.suffix in (".yaml", ".yml") and os.path.isfile(as_path):
        return as_path
    known = list_recipes(folder)
    stem = name.removeprefix(f"{folder}/").removesuffix(".yaml")
    if stem in known:
        return known[stem]
    raise unknown_name(f"{folder}/*.yaml", name, known)


# ------------------------------------------------------------------------------------------ loading


def load_recipe[T](
    folder: Folder,
    name: str,
    cls: type[T],
    *,
    edit: Callable[[dict[str, Any]], None] | None = None,
) -> Recipe[T]:
    """Find a recipe, read it strictly, and return it as an object of `cls`.

    Args:
        folder: the kind of recipe.
        name: see `find_recipe`.
        cls: the dataclass of that kind.
        edit: changes what the file says, before it is checked (flags and overrides).

    Raises:
        UnknownNameError: there is no such recipe.
        RecipeError: it cannot be read, has unknown or missing fields, or values of a wrong type.
    """
    file = _read(folder, name)
    if edit is not None:
        edit(file.data)
    value = decode(cls, file.data, where=file.where)
    return Recipe(name=file.path.stem, path=file.path, sha256=file.sha256, value=value)


def recipe_fields(folder: Folder, name: str) -> frozenset[str]:
    """Return which fields a recipe sets: they tell kinds of one folder apart.

    Raises:
        UnknownNameError: there is no such recipe.
        RecipeError: it cannot be read.
    """
    return frozenset(_read(folder, name).data)


class _File(NamedTuple):
    """A recipe as it was read, not yet checked."""

    path: Path
    where: str
    sha256: str
    data: dict[str, Any]  # Any: plain data of YAML


def _read(folder: Folder, name: str) -> _File:
    path = find_recipe(folder, name)
    check_recorded_name(path.stem, kind=folder)
    where = f"{folder}/{path.name}" if path.parent in search_folders(folder) else str(path)
    try:
        with path.open("rb") as file:
            content = file.read(MAX_CHARACTERS * 4 + 1)  # one more than UTF-8 needs: refused as too large
        text = content.decode("utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise RecipeError(f"{where}: cannot be read as a text file in UTF-8 ({exc}).") from exc
    data = load_yaml(text, where=where)
    if not isinstance(data, dict):
        raise RecipeError(f"{where}: expected fields with values (`name: …`), found {data!r:.60}.")
    return _File(path, where, hashlib.sha256(content).hexdigest(), data)


def apply_overrides(data: dict[str, Any], overrides: Sequence[str], *, cls: type) -> None:
    """Change `data` in place by `a.b=c` each; the value is read as YAML.

    Raises:
        RecipeError: no `=`, no YAML, or no such field.
    """
    for override in overrides:
        path, equals, text = override.partition("=")
        where = f"--set {override:.{MAX_SHOWN}}"
        if not equals or not all(path.split(".")):
            raise RecipeError(f"{where}: expected FIELD=VALUE, for example --set chunking.delay_steps=2.")
        set_field(cls, data, path, load_yaml(text, where=where), where=where)


def to_data(value: Any) -> Any:  # Any: plain data of whatever the recipe holds
    """Return a recipe's value as plain data: mappings, lists, strings, numbers, booleans, None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_data(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_data(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_data(item) for item in value]
    return value
