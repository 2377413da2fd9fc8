"""Names of a task's items, for readers of a report. Standard library only.

In the official order, which is that of the indices in records (`target`, `first_choice`).
"""

from collections.abc import Sequence

# Values and order of the official code, which calls (0, 255, 0) "Lime" and (255, 128, 0) "Olive".
COLOR_RGB = {
    "red": (255, 0, 0),
    "green": (0, 255, 0),
    "blue": (0, 0, 255),
    "yellow": (255, 255, 0),
    "magenta": (255, 0, 255),
    "cyan": (0, 255, 255),
    "maroon": (128, 0, 0),
    "orange": (255, 128, 0),
    "teal": (0, 128, 128),
}
COLOR_NAMES = tuple(COLOR_RGB)
SHAPE_NAMES = ("cube", "sphere", "cylinder", "cross", "torus", "star", "pyramid", "t_shape", "crescent")
# Shapes and colours, the first ones, of tasks whose items differ in both.
MIXED_SHAPE_NAMES = ("cube", "sphere", "t_shape", "cross", "torus")
N_MIXED_COLORS = 3
THING_NAMES = (
    *("banana", "mug", "hammer", "bottle", "apple", "bowl"),
    *("book", "car", "mushroom", "carrot", "cone", "key"),
)  # fmt: skip
_NAMES = {"RememberColor": COLOR_NAMES, "RememberShape": SHAPE_NAMES, "RememberObject": THING_NAMES}


def item_names(task: str, n_items: int, *, given: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return the names of a task's items; of one without a name (mugs, RememberShapeAndColor) its index.

    `given` are those that a record has (`candidate_names`), if any: they come first. `task` is the id of
    a row, of a family, or of the official package: `mikasa_vla/RememberColor3-VLA-v0`.
    """
    if given:
        return tuple(given)
    family = task.rpartition("/")[2].partition("-")[0].rstrip("0123456789")
    names = _NAMES.get(family, ())
    return names[:n_items] if len(names) >= n_items else tuple(map(str, range(n_items)))


def rgb_of(name: str) -> tuple[int, int, int] | None:
    """Return the colour that a name gives, 0 to 255; None if the name is not a colour."""
    return COLOR_RGB.get(name)
