"""Messages with arrays: what is written is read again, as openpi does it; anything else is refused."""

import base64
import io
from typing import Any

import msgpack
import numpy as np
import pytest

from vla_eval.wire import codec
from vla_eval.wire.codec import CodecError, packb, unpackb

ARRAYS = [
    np.arange(6, dtype=np.float32).reshape(2, 3),
    np.array(3.5),
    np.zeros((0, 4), dtype=np.uint8),
    np.array([True, False]),
    np.array(["grasp", "é"]),
    np.array([b"a", b"bc"]),
    np.array([1, -2], dtype=">i4"),
    np.asfortranarray(np.arange(6, dtype=np.uint8).reshape(2, 3)),
    np.arange(12, dtype=np.float16)[::2],
]


def array_map(*, as_text: bool = False, **changes: Any) -> bytes:
    """Return an array as others pack it, with fields replaced."""
    fields = {"__ndarray__": True, "data": b"\0" * 8, "dtype": "<f4", "shape": [2], **changes}
    return msgpack.packb({key if as_text else key.encode(): value for key, value in fields.items()})


@pytest.mark.parametrize("array", ARRAYS, ids=lambda array: array.dtype.str)
def test_an_array_comes_back_with_values_shape_and_type(array: np.ndarray) -> None:
    back = unpackb(packb({"x": array}))["x"]
    np.testing.assert_array_equal(back, array)
    assert back.shape == array.shape
    assert back.dtype == array.dtype.newbyteorder("=")


def test_an_array_that_was_read_can_be_written_into() -> None:
    back = unpackb(packb(np.zeros(3)))
    back[:] = 1.0
    assert back.tolist() == [1.0, 1.0, 1.0]


def test_an_array_is_written_as_openpi_reads_it() -> None:
    # What openpi's `unpack_array` looks for: bytes as keys, all four.
    fields = msgpack.unpackb(packb(np.array([[1.0, 2.0]], dtype=np.float32)), raw=False)
    assert fields == {
        b"__ndarray__": True,
        b"data": b"\x00\x00\x80\x3f\x00\x00\x00\x40",
        b"dtype": "<f4",
        b"shape": [1, 2],
    }


@pytest.mark.parametrize("as_text", [False, True])
def test_markers_may_be_bytes_or_text(as_text: bool) -> None:
    assert unpackb(array_map(as_text=as_text)).tolist() == [0.0, 0.0]


def test_the_data_type_may_be_bytes() -> None:
    assert unpackb(array_map(dtype=b"<f4")).tolist() == [0.0, 0.0]


def test_keys_that_are_bytes_are_read_as_text() -> None:
    assert unpackb(msgpack.packb({b"actions": [1], "x": {b"y": 2}})) == {"actions": [1], "x": {"y": 2}}


@pytest.mark.parametrize(
    "scalar", [np.float32(1.5), np.uint8(255), np.bool_(True), np.int64(-3), np.float16(2)]
)
def test_a_numpy_scalar_comes_back(scalar: np.generic) -> None:
    back = unpackb(packb({"x": scalar}))["x"]
    assert back == scalar
    assert back.dtype == scalar.dtype


def test_plain_data_comes_back_with_tuples_as_lists() -> None:
    message = {"a": [1, 2.5, None, True, "text", b"bytes"], "b": {}, "c": (1, 2)}
    assert unpackb(packb(message)) == {**message, "c": [1, 2]}


@pytest.mark.parametrize(
    "array",
    [
        np.array([object()]),
        np.zeros(1, dtype="i4,f4"),
        np.zeros(1, complex),
        np.zeros(1, "M8[s]"),
        np.zeros(1, np.longdouble),
    ],
    ids=["object", "record", "complex", "time", "longdouble"],
)
def test_other_types_of_arrays_are_not_written(array: np.ndarray) -> None:
    with pytest.raises(CodecError, match="refused"):
        packb({"x": array})


@pytest.mark.parametrize("dtype", ["|O", "|O8", "O", "<c8", "|V4", "<M8", "<m8", "<f16", "g"])
def test_other_types_of_arrays_are_not_read(dtype: str) -> None:
    with pytest.raises(CodecError, match="refused"):
        unpackb(array_map(dtype=dtype))


@pytest.mark.parametrize(
    "dtype", ["f4,i4", "(9,9)f4", "S0", "|S", "<f3", "float32", "", 4, None, "<U" + "9" * 30]
)
def test_a_data_type_that_is_no_simple_one_is_refused(dtype: object) -> None:
    with pytest.raises(CodecError, match="dtype"):
        unpackb(array_map(dtype=dtype))


@pytest.mark.parametrize(
    "shape",
    [
        [3],
        [1],
        [],
        [-2],
        [-1, -2],
        [2.0],
        [True, 2],
        "2",
        None,
        [1] * 17 + [2],
        [0],
        [2**62, 2**62],
        [0, 2**62, 2],
    ],
)
def test_a_shape_that_does_not_match_the_bytes_is_refused(shape: object) -> None:
    with pytest.raises(CodecError, match="an array"):
        unpackb(array_map(shape=shape))


def test_an_empty_array_of_absurd_shape_is_refused() -> None:
    with pytest.raises(CodecError, match="too large"):
        unpackb(array_map(data=b"", shape=[0, 2**62, 2**62]))


def as_msgpack_numpy(value: Any) -> dict[bytes, Any]:
    """Return an array, a numpy scalar or a complex number as `msgpack_numpy.encode` (0.4.8) does."""
    if isinstance(value, complex):
        return {b"complex": True, b"data": repr(value)}
    if not isinstance(value, np.ndarray):
        return {b"nd": False, b"type": value.dtype.str, b"data": value.data.tobytes()}
    kind, names = value.dtype.kind, value.dtype.names
    descr = [list(field) for field in value.dtype.descr] if names else value.dtype.str
    data = value.dumps() if kind == "O" else value.tobytes()
    fields = {b"nd": True, b"type": descr, b"kind": kind.encode() if kind in "VO" else b""}
    return {**fields, b"shape": list(value.shape), b"data": data}


def as_json_numpy(value: Any) -> dict[str, Any]:
    text = base64.b64encode(value.tobytes()).decode()
    return {"__numpy__": text, "dtype": value.dtype.str, "shape": list(value.shape)}


def as_gr00t(value: Any) -> dict[str, Any]:
    file = io.BytesIO()
    np.save(file, value, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


FOREIGN = [
    *(("msgpack-numpy", as_msgpack_numpy(array)) for array in ARRAYS),
    ("msgpack-numpy", as_msgpack_numpy(np.array([object], dtype=object))),  # a pickle
    ("msgpack-numpy", as_msgpack_numpy(np.zeros(2, "i4,f4"))),
    *(("msgpack-numpy", as_msgpack_numpy(scalar)) for scalar in (np.float32(1.5), np.bool_(True), 1 + 2j)),
    *(("json-numpy", as_json_numpy(array)) for array in ARRAYS),
    *(("Isaac-GR00T", as_gr00t(array)) for array in ARRAYS),
]


@pytest.mark.parametrize(("name", "fields"), FOREIGN)
@pytest.mark.parametrize("as_text", [False, True])
def test_an_array_that_another_program_packed_is_refused_by_the_name_of_its_format(
    name: str, fields: dict[Any, Any], as_text: bool
) -> None:
    keys = [key.decode() if as_text and isinstance(key, bytes) else key for key in fields]
    array = dict(zip(keys, fields.values(), strict=True))
    for message in (array, {"observation/image": array}, {"history": [{"a": 1}, [array]]}):
        with pytest.raises(CodecError, match=f"as {name} packs it; .*openpi-client.*b'__ndarray__': True"):
            unpackb(msgpack.packb(message))


@pytest.mark.parametrize("name", ["nd", "type", "data", "complex", "__numpy__", "as_npy", "kind", "shape"])
def test_one_such_key_alone_is_data(name: str) -> None:
    assert unpackb(msgpack.packb({name: True, "x": 1})) == {name: True, "x": 1}


@pytest.mark.parametrize("packer", [array_map, lambda: msgpack.packb(as_msgpack_numpy(np.float32(1.5)))])
def test_arrays_packed_with_bytes_as_text_say_how_to_pack_them(packer: Any) -> None:
    fields = msgpack.unpackb(packer(), raw=False, strict_map_key=False)
    fields[b"data"] = b"\xff\xfe\0\0"  # no UTF-8
    with pytest.raises(CodecError, match=r"use_bin_type=True.*openpi-client"):
        unpackb(msgpack.packb({"x": fields}, use_bin_type=False))


@pytest.mark.parametrize("missing", ["data", "dtype", "shape"])
def test_an_array_without_one_of_its_fields_is_refused(missing: str) -> None:
    with pytest.raises(CodecError, match="an array"):
        unpackb(array_map(**{missing: None}))


def test_bytes_that_no_value_has_are_refused() -> None:
    with pytest.raises(CodecError, match="bool"):
        unpackb(array_map(dtype="|b1", data=b"\x02", shape=[1]))
    with pytest.raises(CodecError, match="character"):
        unpackb(array_map(dtype="<U1", data=b"\xff\xff\xff\xff", shape=[1]))


@pytest.mark.parametrize(
    ("value", "dtype"), [(300, "|u1"), (-1, "|u1"), (2**70, "<i8"), ("1", "<f4"), (True, "<f4"), (1, "|b1")]
)
def test_a_scalar_that_its_type_does_not_hold_is_refused(value: object, dtype: str) -> None:
    if value == 2**70:
        value = 2**64 - 1
    with pytest.raises(CodecError, match="scalar"):
        unpackb(msgpack.packb({b"__npgeneric__": True, b"data": value, b"dtype": dtype}))


def test_keys_that_are_no_text_are_refused() -> None:
    with pytest.raises(CodecError):
        unpackb(msgpack.packb({1: 2}))
    with pytest.raises(CodecError, match="key"):
        packb({1: 2})
    with pytest.raises(CodecError, match="key"):
        unpackb(msgpack.packb({b"\xff": 2}))


def test_a_key_twice_is_refused() -> None:
    with pytest.raises(CodecError, match="twice"):
        unpackb(b"\x82" + msgpack.packb("a") + b"\x01" + msgpack.packb(b"a") + b"\x02")


def test_deep_nesting_is_refused_in_both_directions() -> None:
    deep: Any = 1
    for _ in range(codec.MAX_DEPTH + 1):
        deep = [deep]
    with pytest.raises(CodecError, match="nesting"):
        packb(deep)
    with pytest.raises(CodecError, match="nesting"):
        unpackb(msgpack.packb(deep))
    with pytest.raises(CodecError):
        unpackb(b"\x91" * 100_000)
    assert unpackb(packb(deep[0])) == deep[0]  # the limit itself is allowed


def test_more_items_than_an_observation_ever_has_are_refused() -> None:
    # 2 MB of such bytes would take 130 MB of memory.
    n_items = codec.MAX_ITEMS * 2
    with pytest.raises(CodecError, match="items"):
        unpackb(b"\xdd" + n_items.to_bytes(4, "big") + b"\x90" * n_items)


def test_a_message_that_is_too_large_is_refused_in_both_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = packb(b"x" * 200)
    monkeypatch.setattr(codec, "MAX_MESSAGE_BYTES", 100)
    for ask in (lambda: packb(b"x" * 200), lambda: packb(np.zeros(200)), lambda: unpackb(whole)):
        with pytest.raises(CodecError, match="at most 100"):
            ask()


@pytest.mark.parametrize(
    "data", [b"", b"\xc1", b"\x81", b"\x01\x02", b"\xa1\xff", b"\xd4\x05a", b"\xd6\xff\0\0\0\0"]
)
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(CodecError):
        unpackb(data)


@pytest.mark.parametrize("value", [object(), {1, 2}, 2**70, "\ud800", 1j])
def test_what_is_no_plain_data_is_not_written(value: object) -> None:
    with pytest.raises(CodecError):
        packb({"x": value})
