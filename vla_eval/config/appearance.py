"""How a scene looks, where that is not as the task has it. Knows nothing of simulators."""

from dataclasses import dataclass

from vla_eval.errors import RecipeError
from vla_eval.strict.bounds import check_bounds


@dataclass(frozen=True, slots=True, kw_only=True)
class AppearanceSettings:
    """Changes of light, camera and colours; nothing that moves, and no number of the state, changes.

    Attributes:
        light: factor of all lights.
        camera_shift_m: the base camera stands so much further to the robot's left (+y, world frame).
        camera_turn_deg: it is turned by so much about the vertical, counterclockwise seen from above.
        table_rgb: the table has a plain top of this red, green and blue instead of wood; None: wood.
        hue_deg: the hue of every object of the task is so much further on the circle of hues. Red is 0,
            green 120, blue 240.

    Raises:
        RecipeError: a number out of its range.
    """

    light: float = 1.0
    camera_shift_m: float = 0.0
    camera_turn_deg: float = 0.0
    table_rgb: tuple[float, ...] | None = None
    hue_deg: float = 0.0

    def __post_init__(self) -> None:
        """Check the ranges."""
        bounds = {
            "light": (0.0, 10.0),
            "camera_shift_m": (-0.5, 0.5),
            "camera_turn_deg": (-45.0, 45.0),
            "table_rgb": (0.0, 1.0),
            "hue_deg": (-180.0, 180.0),
        }
        check_bounds(self, bounds, prefix="appearance.")
        if self.table_rgb is not None and len(self.table_rgb) != 3:
            raise RecipeError(f"appearance.table_rgb is {list(self.table_rgb)}, expected three numbers.")


AS_DESIGNED = AppearanceSettings()
