"""How a field of a dataclass says what older files call it."""

FORMERLY = "formerly"


def formerly(name: str) -> dict[str, str]:
    """Return the metadata of a dataclass field that older files call by another name.

    Both names work, the old one with one warning: `field(default=None, metadata=formerly("evaluation"))`.
    """
    return {FORMERLY: name}
