"""Folders of meshes for tests: ten things from trimesh, and the package's own things as files."""

from pathlib import Path

import numpy as np
import trimesh

from vla_eval.tasks.objects.items import Primitive
from vla_eval.tasks.objects.things import THINGS

COLORS = ((200, 40, 40), (40, 160, 60), (40, 70, 200), (230, 190, 40), (150, 60, 170))
FORMATS = (".obj", ".glb", ".stl", ".gltf")
ALONG_X = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0))


def an_l(edge_m: float = 0.036) -> trimesh.Trimesh:
    """A prism over an L, which is not convex."""
    a, b = edge_m, edge_m / 3
    xy = np.array([(0, 0), (a, 0), (a, b), (b, b), (b, a), (0, a)])
    bottom, top = (np.column_stack((xy, np.full(6, z))) for z in (0.0, 0.02))
    faces = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    sides = [(k, (k + 1) % 6, 6 + (k + 1) % 6) for k in range(6)]
    sides += [(k, 6 + (k + 1) % 6, 6 + k) for k in range(6)]
    whole = [*(face[::-1] for face in faces), *(tuple(6 + k for k in face) for face in faces), *sides]
    return trimesh.Trimesh(np.vstack((bottom, top)), whole)


def shapes() -> dict[str, trimesh.Trimesh]:
    """Name -> mesh, m, z up, each with the colour of a material."""
    make = trimesh.creation
    lying = make.capsule(radius=0.01, height=0.03)
    lying.apply_transform(ALONG_X)
    found = {
        "annulus": make.annulus(r_min=0.012, r_max=0.025, height=0.015),
        "brick": make.box((0.05, 0.025, 0.02)),
        "capsule": lying,
        "cone": make.cone(radius=0.02, height=0.04),
        "cube": make.box((0.03, 0.03, 0.03)),
        "ell": an_l(),
        "pillar": make.cylinder(radius=0.012, height=0.05),
        "ring": make.torus(major_radius=0.02, minor_radius=0.008),
        "sphere": make.icosphere(subdivisions=3, radius=0.02),
        "tile": make.box((0.04, 0.04, 0.006)),
    }
    for index, mesh in enumerate(found.values()):
        paint(mesh, COLORS[index % len(COLORS)])
    return found


def paint(mesh: trimesh.Trimesh, rgb: tuple[int, int, int]) -> None:
    """Give a mesh a material of one colour."""
    material = trimesh.visual.material.SimpleMaterial(diffuse=(*rgb, 255))
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(mesh.vertices), 2)), material=material)


def save(mesh: trimesh.Trimesh, file: Path) -> Path:
    """Export a mesh; in glTF it is turned, so that y is up, as its readers expect."""
    if file.suffix in (".glb", ".gltf"):
        mesh = mesh.copy().apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    if file.suffix == ".obj":  # with a material file of its own
        text, others = trimesh.exchange.obj.export_obj(mesh, return_texture=True, mtl_name=f"{file.stem}.mtl")
        file.write_text(text)
        for name, content in others.items():
            (file.parent / name).write_bytes(content)
    elif file.suffix == ".gltf":
        for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
            plain = file.name if name == "model.gltf" else f"{file.stem}_{name}"
            fixed = content.replace(b'"gltf_buffer', f'"{file.stem}_gltf_buffer'.encode())
            (file.parent / plain).write_bytes(fixed if name == "model.gltf" else content)
    else:
        mesh.export(file)
    return file


def folder_of_shapes(folder: Path, n: int = 10) -> Path:
    """The first of ten things, in all formats in turn."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, (name, mesh) in enumerate(list(shapes().items())[:n]):
        save(mesh, folder / f"{name}{FORMATS[index % len(FORMATS)]}")
    return folder


def _part(one: Primitive) -> trimesh.Trimesh:
    if one.kind == "box":
        part = trimesh.creation.box(2 * np.array(one.size))
    elif one.kind == "sphere":
        part = trimesh.creation.icosphere(subdivisions=3, radius=one.size[0])
    else:  # SAPIEN's cylinders lie along x
        part = trimesh.creation.cylinder(radius=one.size[0], height=2 * one.size[1], transform=ALONG_X)
    turn = trimesh.transformations.quaternion_matrix(one.orientation_wxyz)
    part.apply_transform(turn)
    part.apply_translation(one.position_m)
    assert one.rgb is not None
    paint(part, one.rgb)
    return part


def folder_of_things(folder: Path) -> Path:
    """Eleven of the package's own things, a GLB each, whose parts have materials of their own.

    The apple falls over: as the hull of a mesh, its stalk and leaf weigh more than its ball.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, thing in ((name, thing) for name, thing in THINGS.items() if name != "apple"):
        scene = trimesh.Scene([_part(one) for one in thing.parts])
        scene.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
        scene.export(folder / f"{name}.glb")
    return folder
