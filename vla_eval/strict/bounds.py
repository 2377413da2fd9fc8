"""How large the numbers of a recipe may be: with bounds, a typo gives a message at the start."""

import functools
import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple, get_type_hints

from vla_eval.errors import RecipeError

MAX_DEPTH = 50  # of nesting: what this program writes is at most 7 deep
MAX_COUNT = 2**63 - 1
MAX_SEED = 2**32 - 1  # of numpy's `RandomState`, from which ManiSkill takes its generators
MAX_EPISODES = 1_000_000  # in one run folder: its plan and its records are held in memory
MAX_PROCESSES = 1024
MAX_SLOTS = 16_384  # of one worker; on a GPU, ManiSkill simulates some thousands side by side
MAX_SERVER_ROWS = 4096  # of a pass of a policy server
MAX_STEPS = 10_000  # control steps of anything: 500 s
MAX_SECONDS = 7 * 24 * 3600.0
MAX_TRAINING_STEPS = 1_000_000_000
MAX_BATCH = 1_000_000
MIN_IMAGE_SIZE_PX, MAX_IMAGE_SIZE_PX = 16, 2048  # height and width of an image that is rendered


class Bounds(NamedTuple):
    """Least and most, both allowed: `Annotated[int, Bounds(1, 9)]`."""

    least: float
    most: float = math.inf

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:  # Any: pydantic's own types
        """Return pydantic's description of the annotation; that of a number with its bounds."""
        schema = handler(source)
        if schema["type"] not in ("int", "float"):
            return schema
        return {**schema, "ge": self.least} | ({} if math.isinf(self.most) else {"le": self.most})


Count = Annotated[int, Bounds(0, MAX_COUNT)]
Positive = Annotated[int, Bounds(1, MAX_COUNT)]
Rate = Annotated[float, Bounds(0.0, 1.0)]
Seconds = Annotated[float, Bounds(0.0)]
Distance = Annotated[float, Bounds(0.0)]
Episodes = Annotated[int, Bounds(1, MAX_EPISODES)]
Steps = Annotated[int, Bounds(1, MAX_STEPS)]
TrainingSteps = Annotated[int, Bounds(1, MAX_TRAINING_STEPS)]
Slots = Annotated[int, Bounds(1, MAX_SLOTS)]
Workers = Annotated[int | Literal["auto"], Bounds(1, MAX_PROCESSES)]
SecondsAllowed = Annotated[float, Bounds(0.001, MAX_SECONDS)]


@functools.cache
def _bounds_of(cls: type) -> dict[str, Bounds]:
    """Return field -> bounds of a dataclass, also where they are part of a union (`Steps | None`)."""
    return {
        name: mark
        for name, hint in get_type_hints(cls, include_extras=True).items()
        for part in (hint, *getattr(hint, "__args__", ()))
        for mark in getattr(part, "__metadata__", ())
        if isinstance(mark, Bounds)
    }


def check_bounds(
    recipe: object, bounds: Mapping[str, tuple[float, float]] | None = None, *, prefix: str = ""
) -> None:
    """Raise `RecipeError` unless numbers are within (least, most), None or a word, or as annotated."""
    cls: Any = type(recipe)  # Any: mypy does not see that a class can be hashed
    for name, (least, most) in (_bounds_of(cls) if bounds is None else bounds).items():
        value = getattr(recipe, name)
        for number in value if isinstance(value, tuple | list) else (value,):
            if number is None or isinstance(number, str):
                continue
            if not least <= number <= most:
                expected = f"≥ {least:g}" if number < least else f"≤ {most:,}"
                raise RecipeError(f"{prefix}{name} is {number}, expected a number {expected}.")


def check_seeds(first: int, count: int = 1, *, name: str = "seed_start") -> None:
    """Raise `RecipeError` unless `count` seeds from `first` on are seeds that generators take."""
    if first < 0:
        raise RecipeError(f"{name} is {first}, expected a number ≥ 0.")
    if first + count - 1 > MAX_SEED:
        raise RecipeError(
            f"{name} is {first}: the last of {count} seeds would be {first + count - 1}, expected at most "
            f"{MAX_SEED}, the largest seed that numpy and ManiSkill take."
        )


def require(condition: bool, name: str, found: object, expected: str) -> None:
    """Raise `RecipeError` unless the condition holds: `name is found, expected expected`."""
    if not condition:
        raise RecipeError(f"{name} is {found!s:.200}, expected {expected}.")
