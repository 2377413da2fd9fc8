"""Which triangles of the wrist camera's mesh are drawn."""

import logging
import struct
from pathlib import Path

import numpy as np
import pytest

from vla_eval.tasks.arm.camera_mesh import RECORD, read_binary_stl, visible, without_hidden, write_binary_stl
from vla_eval.tasks.arm.robots import _CAMERA_MESH, _PANDA_DIR

N_TRIANGLES = 425_160  # of d415.stl, as its header says


@pytest.fixture(scope="module")
def stl() -> bytes:
    return (_PANDA_DIR / _CAMERA_MESH).read_bytes()


def test_the_triangles_that_are_drawn_are_the_shipped_ones_in_their_order(stl: bytes) -> None:
    (count,) = struct.unpack_from("<I", stl, 80)
    assert count == N_TRIANGLES
    drawn, shipped = without_hidden(stl), read_binary_stl(stl)
    kept = visible(count)
    assert len(drawn) == kept.sum() < count / 4
    assert drawn.tobytes() == shipped[kept].tobytes()


def test_what_lies_outermost_is_drawn(stl: bytes) -> None:
    corners = read_binary_stl(stl)["corners"]
    kept = visible(len(corners))
    for axis in range(3):
        for extreme in (np.argmax, np.argmin):
            outermost = (
                corners[..., axis].max(axis=1) if extreme is np.argmax else corners[..., axis].min(axis=1)
            )
            assert kept[extreme(outermost)]


def test_another_mesh_is_drawn_whole(stl: bytes, caplog: pytest.LogCaptureFixture) -> None:
    other = bytearray(stl)
    other[84 + 12] ^= 1  # a bit of the first corner
    with caplog.at_level(logging.DEBUG):
        drawn = without_hidden(bytes(other))
    assert len(drawn) == N_TRIANGLES
    assert "all of it is drawn" in caplog.text


def test_a_written_mesh_is_read_back(tmp_path: Path) -> None:
    triangles = np.zeros(2, RECORD)
    triangles["corners"] = np.arange(18).reshape(2, 3, 3)
    write_binary_stl(tmp_path / "two.stl", triangles)
    assert read_binary_stl((tmp_path / "two.stl").read_bytes()).tobytes() == triangles.tobytes()
