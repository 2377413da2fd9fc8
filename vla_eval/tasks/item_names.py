"""Names of a task's items, for readers of a report. Standard library only.

In the official order, which is that of the indices in records (`target`, `first_choice`).
"""

COLOR_NAMES = ("red", "green", "blue", "yellow", "magenta", "cyan", "maroon", "orange", "teal")
SHAPE_NAMES = ("cube", "sphere", "cylinder", "cross", "torus", "star", "pyramid", "t_shape", "crescent")
_NAMES = {"RememberColor": COLOR_NAMES, "RememberShape": SHAPE_NAMES}


def item_names(task: str, n_items: int) -> tuple[str, ...]:
    """Return the names of a task's items, by index.

    Args:
        task: id of a row or of a family, such as `RememberColor3-v0` or `RememberColor`.
        n_items: how many there are.

    Returns:
        One name per item; the index itself if the item has no name (mugs), or if its name depends on the
        task's arguments (RememberShapeAndColor).
    """
    family = task.partition("-")[0].rstrip("0123456789")
    names = _NAMES.get(family, ())
    return names[:n_items] if len(names) >= n_items else tuple(map(str, range(n_items)))
