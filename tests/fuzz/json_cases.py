"""Random JSON near to what is valid, and what may come of reading it."""

import json
from collections.abc import Callable
from typing import Any

from hypothesis import strategies as st

from vla_eval.errors import VlaEvalError

NASTY = st.sampled_from(
    (
        *("", ".", "..", "/", "../x", "/etc/passwd", "~", "\0", "\n", "\ud800", "a" * 5000, "=1+1"),
        *("success", "failure", "error", "A", "oracle"),
    )
)
NUMBERS = st.sampled_from((0, 1, 2, 3, 60, -1, 2**31, 2**63, 10**30, 0.5, 7.0)) | st.integers() | st.floats()
LEAVES = st.none() | st.booleans() | NUMBERS | NASTY | st.text(max_size=8)
NAMES = NASTY | st.text(max_size=8)
VALUES = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=4),
    max_leaves=8,
)
BYTES = st.binary(max_size=64) | st.text(alphabet='{}[]",:0123456789eE.-ntf\\ux\n', max_size=64).map(
    str.encode
)


def near(valid: dict[str, Any]) -> st.SearchStrategy[dict[str, Any]]:
    """Return valid data of which some fields are replaced, left out, or too many."""
    names = st.sampled_from(sorted(valid))
    change = st.dictionaries(names | NAMES, VALUES, max_size=3)
    left_out = st.lists(names, max_size=1)
    return st.builds(
        lambda change, left_out: {k: v for k, v in {**valid, **change}.items() if k not in left_out},
        change,
        left_out,
    )


def as_bytes(data: object) -> bytes:
    """Return JSON as Python writes it, with its NaN, infinities and halves of surrogate pairs."""
    return json.dumps(data).encode()


def accepted_or_refused(ask: Callable[[], object]) -> bool:
    """Return whether it is accepted; what the command line would not print as one message is a failure."""
    try:
        ask()
    except VlaEvalError as exc:
        assert str(exc).strip()
        assert len(str(exc)) < 10_000
        str(exc).encode("utf-8")
        return False
    return True
