"""Random bytes and random arrays from a socket: they are read, or refused with a message."""

from typing import Any

import msgpack
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.json_cases import NAMES
from vla_eval.wire.codec import CodecError, packb, unpackb

LEAVES = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.binary(max_size=40)
LEAVES |= st.text(alphabet=st.characters(exclude_categories=["Cs"]), max_size=8)
KEYS = st.sampled_from(["__ndarray__", "__npgeneric__", "data", "dtype", "shape"])
KEYS |= st.text(alphabet="ab/", max_size=3)
DTYPES = st.sampled_from(["<f4", "|u1", "|b1", "<U2", ">i8", "|O", "|V3", "<c8", "S0", "f4,i4"]) | st.text(
    max_size=6
)
DTYPES = DTYPES.filter(lambda text: not any("\ud800" <= letter <= "\udfff" for letter in text))
SHAPES = st.lists(st.integers(-2, 2**64 - 1) | st.integers(0, 4), max_size=20)
ARRAYS = st.fixed_dictionaries(
    {"__ndarray__": st.just(True)},
    optional={"data": st.binary(max_size=64) | LEAVES, "dtype": DTYPES | LEAVES, "shape": SHAPES | LEAVES},
)
SCALARS = st.fixed_dictionaries({"__npgeneric__": st.just(True), "data": LEAVES, "dtype": DTYPES | LEAVES})


def with_bytes_as_keys(message: dict[str, Any]) -> dict[bytes, Any]:
    return {key.encode(): value for key, value in message.items()}


MAPS = ARRAYS | SCALARS | ARRAYS.map(with_bytes_as_keys) | SCALARS.map(with_bytes_as_keys)
MESSAGES = st.recursive(
    LEAVES | MAPS,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(KEYS | KEYS.map(str.encode), inner, max_size=4)
    ),
    max_leaves=8,
)


def read_or_refused(data: bytes) -> None:
    """What is read can be written and is then the same; what is refused has a message."""
    try:
        message = unpackb(data)
    except CodecError as exc:
        assert 0 < len(str(exc)) < 1_000
        str(exc).encode("utf-8")
        return
    assert packb(unpackb(packb(message))) == packb(message)


@given(data=st.binary(max_size=200))
def test_random_bytes_are_read_or_refused(data: bytes) -> None:
    read_or_refused(data)


@given(message=MESSAGES, cut=st.integers(0, 200), noise=st.binary(max_size=4))
def test_messages_that_nearly_fit_are_read_or_refused(message: Any, cut: int, noise: bytes) -> None:
    whole = msgpack.packb(message)
    for data in (whole, whole[:cut] + noise + whole[cut + 1 :]):
        read_or_refused(data)


@given(
    shape=st.lists(st.integers(0, 4), max_size=4),
    dtype=st.sampled_from([np.bool_, np.uint8, np.int64, np.float16, np.float32, ">f8"]),
    names=st.lists(NAMES, min_size=1, max_size=3, unique=True),
    seed=st.integers(0, 100),
)
def test_observations_come_back_as_they_were(
    shape: list[int], dtype: Any, names: list[str], seed: int
) -> None:
    array = np.random.default_rng(seed).integers(0, 2, size=shape).astype(dtype)
    sent = {name.encode("utf-8", "ignore").decode(): array for name in names}
    back = unpackb(packb(sent))
    if isinstance(back, dict):
        assert back.keys() == sent.keys()
        for value in back.values():
            np.testing.assert_array_equal(value, array)
