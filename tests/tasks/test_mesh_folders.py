"""Which folders of meshes a task takes; whatever else there can be in one is refused with a reason."""

import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.tasks.hostile_meshes import BOX, HOSTILE, box
from tests.tasks.made_meshes import FORMATS, an_l, folder_of_shapes, paint, save, shapes
from vla_eval.errors import TaskArgumentError
from vla_eval.tasks.objects.mesh_folder import without_path
from vla_eval.tasks.objects.meshes import read_meshes
from vla_eval.tasks.objects.things import THINGS


def refusal(folder: Path, **options: object) -> str:
    with pytest.raises(TaskArgumentError) as found:
        read_meshes(str(folder), **options)  # type: ignore[arg-type]  # as a user could
    return str(found.value)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_mesh_is_the_same_thing_in_each_format(tmp_path: Path, suffix: str) -> None:
    mesh = an_l()
    paint(mesh, (10, 120, 230))
    mesh.apply_translation((3.0, -2.0, 7.0))
    save(mesh, tmp_path / f"an l-1.0{suffix}")
    (found,) = read_meshes(str(tmp_path)).meshes
    assert found.name == "an l-1.0"
    (surface,) = found.solid.surfaces
    places = surface.vertices_m[surface.triangles.ravel()]
    # An L of 3.6 cm and a height of 2 cm: z from -1 to 1 cm, and the circle around it through three corners.
    np.testing.assert_allclose(np.ptp(places, axis=0), (0.036, 0.036, 0.02), atol=2e-6)
    np.testing.assert_allclose(places[:, 2].max(), 0.01, atol=2e-6)
    assert found.solid.height_m == pytest.approx(0.02, abs=2e-6)
    assert np.hypot(*places[:, :2].T).max() == pytest.approx(0.036 / np.sqrt(2), rel=0.01)
    # Twelve corners, of which one is within the hull in x and y: the inner corner of the L, twice.
    assert len(found.solid.hull_m) == 10
    assert surface.rgb == ((150, 150, 150) if suffix == ".stl" else (10, 120, 230))
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("suffix", [suffix for suffix in FORMATS if suffix != ".stl"])
def test_a_texture_is_drawn_where_its_coordinates_say(tmp_path: Path, suffix: str) -> None:
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:4, 4:] = (220, 30, 30)  # the corner at u, v > 0.5
    mesh = box()
    uv = (mesh.vertices[:, :2] + np.array(BOX[:2]) / 2) / BOX[:2]
    of_gltf = {"baseColorTexture": Image.fromarray(pixels)}
    material = trimesh.visual.material.PBRMaterial(**of_gltf)
    if suffix == ".obj":
        material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(pixels))
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    save(mesh, tmp_path / f"tile{suffix}")
    ((surface,),) = [one.solid.surfaces for one in read_meshes(str(tmp_path)).meshes]
    assert surface.texture is not None and surface.texture.shape == (8, 8, 4)
    assert surface.rgb == (255, 255, 255)
    for place, (u, v) in zip(surface.vertices_m, surface.uvs, strict=True):
        assert (u > 0.5, v > 0.5) == (place[0] > 0, place[1] > 0)


def test_the_first_by_name_are_the_candidates_and_others_are_named(tmp_path: Path) -> None:
    folder = folder_of_shapes(tmp_path)
    (folder / "LICENSE.txt").write_text("mine")
    found = read_meshes(str(folder))
    names = sorted(shapes())
    assert [one.name for one in found.candidates(3)] == names[:3]
    assert [one.name for one in found.meshes] == names
    assert found.unread == ("LICENSE.txt",) and "LICENSE.txt" in found.note
    with pytest.raises(TaskArgumentError, match=r"at least 12 meshes.*found 10 \(not read: LICENSE.txt\)"):
        found.candidates(12)


def test_a_folder_as_maniskill_downloads_ycb_is_read(tmp_path: Path) -> None:
    for index, name in enumerate(("025_mug", "011_banana")):
        model = tmp_path / "models" / name
        model.mkdir(parents=True)
        save(box(0.04, 0.03, 0.02 + 0.01 * index), model / "textured.obj")
        (model / "collision.ply").write_bytes(b"not read")
    (tmp_path / "info_pick_v0.json").write_text("{}")
    found = read_meshes(str(tmp_path))
    assert [one.name for one in found.meshes] == ["011_banana", "025_mug"]
    assert "models/025_mug/textured.obj" in found.sha256
    (tmp_path / "models" / "empty").mkdir()
    assert "models/empty/textured.obj" in refusal(tmp_path)


def test_the_digest_is_of_contents_and_names_alone(tmp_path: Path) -> None:
    one, other = (folder_of_shapes(tmp_path / name, n=5) for name in ("one", "other"))
    digests = [read_meshes(str(folder)).asked.digest for folder in (one, other)]
    assert digests[0] == digests[1]
    pinned = read_meshes(str(one)).pinned
    assert pinned == f"{one}@{digests[0]}" and read_meshes(pinned).pinned == pinned
    assert without_path({"meshes": pinned, "n_items": 3}) == {"meshes": f"one@{digests[0]}", "n_items": 3}
    for change in (
        lambda: (one / "annulus.mtl").write_text((one / "annulus.mtl").read_text() + "# \n"),
        lambda: (one / "cube.obj").rename(one / "die.obj"),
        lambda: save(box(), one / "zebra.stl"),
    ):
        change()
        with pytest.raises(TaskArgumentError, match=rf"expected the files of one@{digests[0]}, found others"):
            read_meshes(pinned)
        assert read_meshes(str(one)).asked.digest not in digests
        digests.append(read_meshes(str(one)).asked.digest or "")


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1000.0, r"millimetres: scale the file by 0.001, or set env.mesh_scale=0.001"),
        (100.0, r"centimetres: scale the file by 0.01, or"),
        (1 / 0.0254, r"inches: scale the file by 0.0254, or"),
        (3.0, r"env.mesh_scale \(at most 0.4 for it\)"),  # 0.0305 m / (0.025 m · 3) = 0.407
        (0.1, r"at least 0.02 m long. Scale the file, or set env.mesh_scale \(at most 12 for it\)"),
    ],
)
def test_another_unit_is_named_and_converted_on_request_alone(
    tmp_path: Path, factor: float, said: str
) -> None:
    mesh = box()  # half of its diagonal is 2.5 cm
    mesh.apply_scale(factor)
    save(mesh, tmp_path / "brick.stl")
    with pytest.raises(TaskArgumentError, match=said):
        read_meshes(str(tmp_path))
    (found,) = read_meshes(str(tmp_path), scale=1 / factor).meshes
    assert found.solid.height_m == pytest.approx(0.02, rel=1e-5)


@pytest.mark.parametrize(
    ("edges_m", "said"),
    [
        ((0.03, 0.03, 0.0605), "at most 0.06 m high"),
        ((0.0611, 0.002, 0.02), "within 0.0305 m of the vertical"),
        ((0.0199, 0.01, 0.01), "at least 0.02 m long"),
        ((0.04, 0.04, 0.0019), "at least 0.002 m thick"),
    ],
)
def test_a_thing_just_too_large_or_small_is_refused(
    tmp_path: Path, edges_m: tuple[float, float, float], said: str
) -> None:
    save(box(*edges_m), tmp_path / "brick.stl")
    assert said in refusal(tmp_path)


@pytest.mark.parametrize("name", sorted(THINGS))
def test_our_own_sizes_are_within_the_limits(name: str) -> None:
    """What holds of things holds of meshes: how far the hand stays above them."""
    assert THINGS[name].rest_height_m <= 0.03


def _leaning(angle_deg: float) -> trimesh.Trimesh:
    pillar = trimesh.creation.cylinder(radius=0.008, height=0.05)
    pillar.apply_transform(trimesh.transformations.rotation_matrix(np.deg2rad(angle_deg), (1, 0, 0)))
    return pillar


UNSTEADY = {
    "a cone on its tip": lambda: trimesh.creation.cone(radius=0.02, height=0.04).apply_scale((1, 1, -1)),
    "a capsule on its end": lambda: trimesh.creation.capsule(radius=0.01, height=0.03),
    "a pillar on its edge": lambda: _leaning(30),
    "a cube on its corner": lambda: box(0.03, 0.03, 0.03).apply_transform(
        trimesh.transformations.euler_matrix(np.pi / 4, np.arctan(np.sqrt(0.5)), 0)
    ),
}
STEADY = {
    "a ball": lambda: trimesh.creation.icosphere(subdivisions=2, radius=0.03),
    "a pillar": lambda: _leaning(0),
    "a lying pillar": lambda: _leaning(90),
    "a cone": lambda: trimesh.creation.cone(radius=0.01, height=0.055),
}


@pytest.mark.parametrize("name", [*UNSTEADY, *STEADY])
def test_what_falls_over_as_it_stands_is_refused(tmp_path: Path, name: str) -> None:
    make: Callable[[], trimesh.Trimesh] = {**UNSTEADY, **STEADY}[name]
    mesh = make()
    mesh.fix_normals()
    save(mesh, tmp_path / "it.stl")
    if name in UNSTEADY:
        assert "falls over as it stands in its file" in refusal(tmp_path)
    else:
        assert read_meshes(str(tmp_path)).meshes[0].name == "it"


def test_holes_are_refused_unless_they_are_accepted(tmp_path: Path) -> None:
    mesh = box()
    mesh.update_faces(np.arange(len(mesh.faces)) != 3)  # a triangle of twelve is missing: three open edges
    save(mesh, tmp_path / "open.obj")
    assert "holes (3 open edges)" in refusal(tmp_path) and "env.mesh_holes=true" in refusal(tmp_path)
    assert len(read_meshes(str(tmp_path), allow_holes=True).meshes) == 1


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_folder_is_refused_with_a_reason(
    tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_connection(*args: object) -> None:
        raise AssertionError("a connection")

    monkeypatch.setattr(socket.socket, "connect", no_connection)
    folder = tmp_path / "meshes"
    folder.mkdir()
    Image.new("L", (2, 2)).save(tmp_path / "secret.png")
    (tmp_path / "secret.mtl").write_text("newmtl m\n")
    spoil, said = HOSTILE[case]
    spoil(folder)
    message = refusal(folder)
    assert said in message and str(folder) in message and message.endswith(".") and len(message) < 900
    assert message.isprintable()


def test_all_meshes_that_are_wrong_are_named_in_one_message(tmp_path: Path) -> None:
    for index in range(7):
        save(box(1 + index, 1, 1), tmp_path / f"m{index}.stl")
    message = refusal(tmp_path)
    assert all(f"m{index}.stl" in message for index in range(5)) and message.endswith("And 2 more.")


@pytest.mark.parametrize("text", ["nowhere", "a_file", "", "a\0b", "a" * 5000, "~nobody_of_this_name/meshes"])
def test_a_folder_that_is_none_is_refused(tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_file").write_text("")
    with pytest.raises(TaskArgumentError, match="expected a folder of meshes") as found:
        read_meshes(text)
    assert len(str(found.value)) < 500 and str(found.value).isprintable()


def test_what_a_desktop_leaves_in_a_folder_is_no_mesh(tmp_path: Path) -> None:
    save(box(), tmp_path / "box.stl")
    (tmp_path / "._box.stl").write_bytes(b"\0\5")
    (tmp_path / ".DS_Store").write_bytes(b"")
    found = read_meshes(str(tmp_path))
    assert [one.name for one in found.meshes] == ["box"] and found.unread == (".DS_Store", "._box.stl")
