"""Keep old names of fields in YAML files and of flags working, with one warning that gives the new name.

Knows nothing of what the fields mean. A dataclass names the old field at the new one:
`capture: CaptureConfig = field(default_factory=CaptureConfig, metadata=formerly("recording"))`.
"""

import dataclasses
import functools
import logging
from typing import Any

from vla_eval.errors import RecipeError

logger = logging.getLogger(__name__)

FORMERLY = "formerly"


def formerly(name: str) -> dict[str, str]:
    """Return the metadata of a dataclass field that older files call by another name."""
    return {FORMERLY: name}


def current_names(cls: type) -> dict[str, str]:
    """Return old name -> current name of the renamed fields of a dataclass."""
    fields = (field for field in dataclasses.fields(cls) if FORMERLY in field.metadata)
    return {field.metadata[FORMERLY]: field.name for field in fields}


def use_current_names(cls: type, data: dict[str, Any], *, prefix: str) -> None:
    """Give the renamed fields in the plain data of a dataclass their current names, in place."""
    for old, new in current_names(cls).items():
        if old not in data:
            continue
        if new in data:
            raise RecipeError(
                f"'{prefix}{old}' is the old name of '{prefix}{new}', and both are there. "
                f"Keep '{prefix}{new}'."
            )
        warn_renamed(f"'{prefix}{old}'", f"'{prefix}{new}'")
        data[new] = data.pop(old)


@functools.cache  # one warning per name and process
def warn_renamed(old: str, new: str) -> None:
    """Log that something has a new name."""
    logger.warning(
        "warning: %s is now called %s. The old name still works; please use the new one.", old, new
    )
