"""Damaged meshes of a user's folder: each is taken whole, or refused with a message."""

from pathlib import Path

import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.json_cases import BYTES, accepted_or_refused
from tests.tasks.made_meshes import FORMATS, paint, save
from vla_eval.tasks.objects.meshes import read_meshes

EDGES_M = (0.04, 0.03, 0.02)


def whole(folder: Path, suffix: str) -> Path:
    mesh = trimesh.creation.box(EDGES_M)
    paint(mesh, (200, 30, 40))
    folder.mkdir()
    return save(mesh, folder / f"box{suffix}")


def read(folder: Path) -> None:
    for mesh in read_meshes(str(folder)).meshes:
        assert len(mesh.solid.hull_m) >= 4 and all(len(one.triangles) for one in mesh.solid.surfaces)


@given(data=st.data(), suffix=st.sampled_from(FORMATS))
def test_a_mesh_with_other_bytes(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, data: st.DataObject
) -> None:
    file = whole(tmp_path_factory.mktemp("fuzz") / "meshes", suffix)
    content = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        first = data.draw(st.integers(0, len(content)))
        n_lost = data.draw(st.sampled_from((0, 1, 4, 40)))
        content[first : first + n_lost] = data.draw(
            st.binary(max_size=6) | st.sampled_from((b"9" * 12, b"nan ", b"-"))
        )
    file.write_bytes(bytes(content))
    accepted_or_refused(lambda: read(file.parent))


@given(content=BYTES, suffix=st.sampled_from((*FORMATS, ".mtl")))
def test_a_mesh_of_any_bytes(tmp_path_factory: pytest.TempPathFactory, suffix: str, content: bytes) -> None:
    file = whole(tmp_path_factory.mktemp("fuzz") / "meshes", ".obj" if suffix == ".mtl" else suffix)
    file.with_suffix(suffix).write_bytes(content)
    accepted_or_refused(lambda: read(file.parent))
