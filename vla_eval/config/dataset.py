"""`datasets/*.yaml`: which demonstrations, how recorded, how many. Knows nothing of lerobot or simulators."""

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from vla_eval.config.environment import RenderSettings, Simulator
from vla_eval.config.evaluation import TimeoutConfig
from vla_eval.config.files import check_run_name, content_of, digest_of
from vla_eval.errors import RecipeError
from vla_eval.features import EncoderSettings, StateKind
from vla_eval.strict.bounds import (
    MAX_EPISODES,
    MAX_STEPS,
    Bounds,
    Episodes,
    Workers,
    check_bounds,
    check_seeds,
)

MAX_ACTION_NOISE = 10.0  # actions lie between -1 and 1: more is all noise
EVALUATION_SEEDS = range(1, 101)
"""The default evaluation's seeds. No demonstration may show them: the policy would be tested on them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetRecipe:
    """Demonstrations of one or more tasks. `docs/datasets.md` has the table of all fields.

    Raises:
        RecipeError: a value out of its range, something named twice, or seeds that evaluation uses.
    """

    name: str
    tasks: tuple[str, ...]
    description: str = ""
    episodes: Episodes = 250
    seed_start: int = 1000
    expert: str = "oracle"
    prompt_set: str = "paper"
    state: StateKind = "eef"
    keep: Literal["successes", "all"] = "successes"
    cut: Literal["after_success", "horizon"] = "after_success"
    steps_after_success: Annotated[int, Bounds(0, MAX_STEPS)] = 5
    action_noise: Annotated[float, Bounds(0, MAX_ACTION_NOISE)] = 0.0
    stored_action: Literal["executed", "intended"] = "executed"
    env: dict[str, Any] = field(default_factory=dict)  # Any: the task checks its arguments
    render: RenderSettings = field(default_factory=RenderSettings)
    simulator: Simulator = "maniskill"
    encoder: EncoderSettings = field(default_factory=EncoderSettings)
    episodes_per_shard: Episodes = 10
    max_failed_seeds: Annotated[int, Bounds(0, MAX_EPISODES)] = 250
    workers: Workers = "auto"
    timeouts: TimeoutConfig = field(default_factory=TimeoutConfig)

    def __post_init__(self) -> None:
        check_run_name(self.name)
        if not self.tasks or len(set(self.tasks)) != len(self.tasks):
            raise RecipeError(f"tasks is {list(self.tasks)}, expected at least one, none of them twice.")
        check_bounds(self)
        check_seeds(self.seed_start, self.episodes + self.max_failed_seeds)
        first, last = EVALUATION_SEEDS[0], EVALUATION_SEEDS[-1]
        if self.seed_start <= last and self.last_seed >= first:
            raise RecipeError(
                f"seed_start is {self.seed_start}: with {self.episodes} episodes and up to "
                f"{self.max_failed_seeds} failed seeds, demonstrations would use seeds {self.seed_start} to "
                f"{self.last_seed}, which overlap the evaluation's seeds {first} to {last}. A policy must "
                f"not be tested on what it was shown: use a seed_start above {last}, such as 1000."
            )

    @property
    def last_seed(self) -> int:
        """The highest seed that may be tried before the recording fails."""
        return self.seed_start + self.episodes + self.max_failed_seeds - 1


OPTION_FIELDS = ("name", "description", "workers", "timeouts")
"""Fields of `DatasetRecipe` that content does not depend on: they may differ when a recording is resumed."""


def fingerprint(recipe: DatasetRecipe) -> str:
    """Return the sha256 of the part of a recipe that the dataset's content depends on."""
    return digest_of(content_of(recipe, options=OPTION_FIELDS))
