"""How a scene looks, where that is not as the task has it. Knows nothing of simulators."""

from dataclasses import dataclass
from typing import Annotated

from vla_eval.errors import RecipeError
from vla_eval.strict.bounds import Bounds, check_bounds


@dataclass(frozen=True, slots=True, kw_only=True)
class AppearanceSettings:
    """Changes of light, camera and colours; nothing that moves, and no number of the state, changes."""

    light: Annotated[float, Bounds(0.0, 10.0)] = 1.0  # factor of all lights
    # the base camera stands so much further to the robot's left (+y, world frame)
    camera_shift_m: Annotated[float, Bounds(-0.5, 0.5)] = 0.0
    # it is turned by so much about the vertical, counterclockwise seen from above
    camera_turn_deg: Annotated[float, Bounds(-45.0, 45.0)] = 0.0
    # the table has a plain top of this red, green and blue instead of wood; None: wood
    table_rgb: Annotated[tuple[float, ...] | None, Bounds(0.0, 1.0)] = None
    # the hue of every object of the task is so much further on the circle of hues. Red is 0, green 120,
    # blue 240.
    hue_deg: Annotated[float, Bounds(-180.0, 180.0)] = 0.0

    def __post_init__(self) -> None:
        check_bounds(self, prefix="appearance.")
        if self.table_rgb is not None and len(self.table_rgb) != 3:
            raise RecipeError(f"appearance.table_rgb is {list(self.table_rgb)}, expected three numbers.")


AS_DESIGNED = AppearanceSettings()
