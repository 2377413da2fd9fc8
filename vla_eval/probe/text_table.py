"""What the texts of probes and grids share. Knows nothing of what is in their tables."""

from collections.abc import Sequence
from typing import Any

from vla_eval.probe.retention import Range
from vla_eval.results.estimates import Interval, Share
from vla_eval.results.printed_table import UNDEFINED, csv_text

JsonRow = dict[str, Any]  # Any: JSON


def rows_as_csv(rows: Sequence[JsonRow]) -> str:
    """Return rows with the same keys as CSV; what is undefined is empty, lists are joined by spaces."""
    flat = [
        {name: " ".join(map(str, value)) if isinstance(value, list) else value for name, value in row.items()}
        for row in rows
    ]
    return csv_text(list(rows[0]), flat)


def error_notes(n_errors: int) -> list[str]:
    """Return the note on episodes without a result, if there are any."""
    text = f"{n_errors} episodes ended in an error and are not counted; the same command retries them."
    return [text] if n_errors else []


def success_json(success: Share | None) -> JsonRow:
    """Return how many succeed, their share and its interval; undefined values are null."""
    return {
        "n_success_once": success.n if success else None,
        "success_once": success.rate if success else None,
        "ci_low": success.interval.low if success else None,
        "ci_high": success.interval.high if success else None,
    }


def shown_rate(rate: float, interval: Interval | Range) -> str:
    """Return `0.50 [0.40, 0.60]`; an end that is not known is `—`."""
    low, high = (UNDEFINED if end is None else f"{end:.2f}" for end in interval)
    return f"{rate:.2f} [{low}, {high}]"
