"""Folders of meshes that are refused: what each has in it, and what the message says."""

import base64
import json
import os
import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from tests.tasks.made_meshes import FORMATS, paint, save
from vla_eval.tasks.objects.mesh_folder import MAX_FILE_BYTES

BOX = (0.04, 0.03, 0.02)


def box(*edges_m: float) -> trimesh.Trimesh:
    return trimesh.creation.box(edges_m or BOX)


def text_of(mesh: trimesh.Trimesh) -> str:
    return str(trimesh.exchange.obj.export_obj(mesh))


def _same(folder: Path, first: str, second: str) -> None:
    save(box(), folder / first)
    save(box(), folder / second)


def _painted(folder: Path) -> None:
    mesh = box()
    mesh.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4) * 7
    save(mesh, folder / "it.glb")


def _gltf(folder: Path, change: Callable[[dict[str, object]], object]) -> None:
    file = save(box(), folder / "it.gltf")
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def _obj(folder: Path, *lines: str) -> None:
    (folder / "it.obj").write_text("\n".join((*lines, text_of(box()))))


def _mtl(folder: Path, line: str) -> None:
    mesh = box()
    paint(mesh, (1, 2, 3))
    file = save(mesh, folder / "it.obj")
    file.with_suffix(".mtl").write_text(file.with_suffix(".mtl").read_text() + f"\n{line}\n")


def _cut(folder: Path, suffix: str, share: float) -> None:
    file = save(box(), folder / f"it{suffix}")
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])


def _linked(folder: Path, target: Path) -> None:
    save(box(), target)
    (folder / "it.stl").symlink_to(target)


def _big(folder: Path) -> None:
    with (folder / "it.stl").open("wb") as file:
        file.truncate(MAX_FILE_BYTES + 1)


def _points(folder: Path, text: str) -> None:
    (folder / "it.obj").write_text(text)


def _nan(folder: Path) -> None:
    (folder / "it.obj").write_text(re.sub(r"^v \S+", "v nan", text_of(box()), count=1, flags=re.M))


def _huge_image(folder: Path) -> None:
    _mtl(folder, "map_Kd big.png")
    Image.new("L", (5000, 2)).save(folder / "big.png")


def _bomb(folder: Path) -> None:
    """A PNG whose header says 60,000 x 60,000 pixels."""
    _mtl(folder, "map_Kd big.png")
    Image.new("L", (2, 2)).save(folder / "big.png")
    content = bytearray((folder / "big.png").read_bytes())
    content[16:24] = struct.pack(">II", 60_000, 60_000)
    (folder / "big.png").write_bytes(content)


def _two_textures(folder: Path) -> None:
    """A glTF of two parts, each with an image, of which one is damaged."""
    scene = trimesh.Scene()
    for index in range(2):
        part = box()
        part.apply_translation((0, 0, 0.02 * index))
        image = Image.new("RGB", (4, 4), (index * 200, 9, 9))
        material = trimesh.visual.material.PBRMaterial(name=f"m{index}", baseColorTexture=image)
        part.visual = trimesh.visual.TextureVisuals(uv=part.vertices[:, :2], material=material)
        scene.add_geometry(part)
    scene.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    content = bytearray(scene.export(file_type="glb"))
    second = content.index(b"\x89PNG", content.index(b"\x89PNG") + 1)
    content[second : second + 4] = b"none"
    (folder / "it.glb").write_bytes(content)


def _sheet(folder: Path) -> None:
    """A sheet over the diagonal, without a thickness."""
    corners = np.array([(0, 0, 0), (0.03, 0.03, 0), (0.03, 0.03, 0.03), (0, 0, 0.03)])
    save(trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)]), folder / "it.stl")


OUT = "data:application/octet-stream;base64," + base64.b64encode(b"x").decode()
HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "nothing in it": (lambda folder: None, "no mesh in it"),
    "other files alone": (lambda folder: (folder / "a.blend").write_text(""), "it has a.blend"),
    "one name in two formats": (
        lambda folder: _same(folder, "it.obj", "it.stl"),
        "several meshes of the name",
    ),
    "a mesh twice": (lambda folder: _same(folder, "it.stl", "other.stl"), "the same as 'it'"),
    "a mesh twice, in two formats": (lambda folder: _same(folder, "it.stl", "b.obj"), "the same as 'b'"),
    "a name with a control character": (lambda folder: save(box(), folder / "a\x1b[31m.stl"), "the name"),
    "a long name": (lambda folder: save(box(), folder / f"{'a' * 65}.stl"), "the name"),
    "colours of corners": (_painted, "Bake them into a texture"),
    "triangles inwards": (
        lambda folder: save(trimesh.Trimesh(box().vertices, box().faces[:, ::-1]), folder / "it.stl"),
        "face inwards",
    ),
    "empty": (lambda folder: (folder / "it.obj").write_text(""), "it.obj"),
    "empty stl": (lambda folder: (folder / "it.stl").write_bytes(b""), "expected triangles, found none"),
    "points alone": (lambda folder: _points(folder, "v 0 0 0\nv 1 0 0\n"), "it.obj"),
    "text": (lambda folder: (folder / "it.glb").write_text("hello"), "cannot be read as a mesh"),
    "one damaged texture of two": (_two_textures, "a texture of it cannot be read"),
    "a sheet": (_sheet, "cannot be read as a mesh"),
    "an extension that it needs": (
        lambda folder: _gltf(folder, lambda data: data.update(extensionsRequired=["KHR_draco"])),
        "needs extensions of glTF (KHR_draco)",
    ),
    "no number": (_nan, "no numbers, or more than"),
    "far away": (lambda folder: save(box().apply_scale(1e9), folder / "it.stl"), "more than 1,000 km"),
    "a triangle that is a line": (lambda folder: _points(folder, "v 0 0 0\nv 1 0 0\nf 1 2 1\n"), "it.obj"),
    "a folder with the name of a mesh": (lambda folder: (folder / "it.stl").mkdir(), "no plain file"),
    "a pipe": (lambda folder: os.mkfifo(folder / "it.stl"), "no plain file"),
    "too large": (_big, "expected at most 64"),
    "a link that leads out": (lambda folder: _linked(folder, folder.parent / "secret.stl"), "outside of the"),
    "a link to nothing": (lambda folder: (folder / "it.stl").symlink_to("gone.stl"), "cannot be read"),
    "a material outside": (lambda folder: _obj(folder, "mtllib ../secret.mtl"), "outside of the folder"),
    "a material by its whole path": (lambda folder: _obj(folder, "mtllib /etc/passwd"), "outside of the"),
    "a missing material": (lambda folder: _obj(folder, "mtllib none.mtl"), "'none.mtl' cannot be read"),
    "a texture outside": (lambda folder: _mtl(folder, "map_Kd ../../secret.png"), "outside of the folder"),
    "a texture that is another file": (lambda folder: _mtl(folder, "map_Kd it.obj"), "its image 'it.obj'"),
    "a missing texture": (lambda folder: _mtl(folder, "map_Kd none.png"), "'none.png' cannot be read"),
    "a texture with many pixels": (_huge_image, "5000 x 2 pixels"),
    "a texture that unpacks to gigabytes": (_bomb, "its image 'big.png'"),
    "a buffer outside": (
        lambda folder: _gltf(folder, lambda data: data["buffers"][0].update(uri="../it.bin")),  # type: ignore[index]
        "outside of the folder",
    ),
    "a buffer by its address": (
        lambda folder: _gltf(folder, lambda data: data["buffers"][0].update(uri="https://a.org/b")),  # type: ignore[index]
        "nothing is fetched",
    ),
    "a buffer that is too short": (
        lambda folder: _gltf(folder, lambda data: data["buffers"][0].update(uri=OUT)),  # type: ignore[index]
        "it.gltf",
    ),
    "numbers without end": (
        lambda folder: _gltf(folder, lambda data: data["accessors"][0].update(count=10**12)),  # type: ignore[index]
        "more parts or numbers",
    ),
    "parts without end": (
        lambda folder: _gltf(folder, lambda data: data.update(nodes=[{"mesh": 0}] * 2000)),
        "more parts or numbers",
    ),
    "json that is no object": (lambda folder: (folder / "it.gltf").write_text("[]"), "it is no glTF"),
    "json that is deep": (lambda folder: (folder / "it.gltf").write_text("[" * 100_000), "cannot be read"),
    **{
        f"{share:g} of a {suffix}": (lambda folder, s=suffix, n=share: _cut(folder, s, n), f"it{suffix}")
        for suffix in FORMATS
        for share in (0.05, 0.5, 0.95)
    },
}
