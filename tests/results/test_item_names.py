"""The names that a report uses are those of what lies on the table."""

import pytest

from vla_eval.tasks.objects.item_names import COLOR_NAMES, SHAPE_NAMES, item_names


def test_colors_and_shapes_are_called_as_the_simulator_builds_them() -> None:
    from vla_eval.tasks.objects.items import COLORS, SHAPES

    assert tuple(color.name for color in COLORS) == COLOR_NAMES
    assert tuple(SHAPES) == SHAPE_NAMES


@pytest.mark.parametrize(
    ("task", "n_items", "names"),
    [
        ("RememberColor3-v0", 3, ("red", "green", "blue")),
        ("RememberColor", 4, ("red", "green", "blue", "yellow")),
        ("RememberShape5-v0", 2, ("cube", "sphere")),
        # Which item is which depends on an argument, and mugs are all alike.
        ("RememberShapeAndColor3x2-v0", 6, ("0", "1", "2", "3", "4", "5")),
        ("ShellGameTouch-v0", 3, ("0", "1", "2")),
    ],
)
def test_items_without_a_name_of_their_own_have_a_number(
    task: str, n_items: int, names: tuple[str, ...]
) -> None:
    assert item_names(task, n_items) == names
