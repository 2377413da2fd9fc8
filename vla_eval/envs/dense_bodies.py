"""Bodies of which an image shows few triangles, so many they have: their meshes, read once, and parts.

A body of some of its triangles is drawn as they are drawn in the whole: the same numbers, in the same order.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any  # SAPIEN is untyped: its entities and components are Any here

import numpy as np
import sapien
from numpy.typing import NDArray

from vla_eval.envs.pixel_cover import Chosen, Floats, Matrix, Mesh

DENSE = 5_000  # triangles of a body whose triangles are looked at one by one
FRONT = "counterclockwise"  # of a mesh's faces, as SAPIEN makes them from arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """What a shape with one material is made of."""

    vertices: Floats  # (V, 3)
    normals: Floats  # (V, 3)
    uvs: Floats  # (V, 2)
    triangles: NDArray[np.uint32]  # (T, 3)
    material: Any
    scale: Floats
    local_pose: Any

    def only(self, chosen: Chosen) -> Any:
        """Return a shape of the triangles (T,) that are chosen, in their order."""
        used = self.triangles[chosen].reshape(-1)
        triangles = np.arange(len(used), dtype=np.uint32).reshape(-1, 3)
        shape = sapien.render.RenderShapeTriangleMesh(
            self.vertices[used], triangles, self.normals[used], self.uvs[used], self.material
        )
        shape.scale, shape.local_pose = self.scale, self.local_pose
        return shape


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseBody:
    """A body whose triangles are looked at one by one: the same in every episode."""

    mesh: Mesh  # of all parts, in the body's frame
    parts: tuple[Part, ...]
    box: Matrix  # (8, 4) its corners, homogeneous
    shading_mode: int

    @classmethod
    def of(cls, body: Any) -> "DenseBody":
        """Read the meshes of what is rendered of a body."""
        parts, vertices, triangles, n_vertices = [], [], [], 0
        for shape, part in _parts(body):
            read = Part(
                vertices=np.array(part.vertices),
                normals=np.array(part.get_vertex_normal()),
                uvs=np.array(part.get_vertex_uv()),
                triangles=np.array(part.triangles),
                material=part.material,
                scale=np.array(shape.scale),
                local_pose=shape.local_pose,
            )
            frame = read.local_pose.to_transformation_matrix()
            vertices.append(read.vertices * read.scale @ frame[:3, :3].T + frame[:3, 3])
            triangles.append(read.triangles + n_vertices)
            n_vertices += len(read.vertices)
            parts.append(read)
        mesh = Mesh.of(np.vstack(vertices), np.vstack(triangles))
        lowest, highest = mesh.points.min(axis=1), mesh.points.max(axis=1)
        chosen = np.indices((2, 2, 2)).reshape(3, 8).T
        box = np.hstack((np.where(chosen, highest, lowest), np.ones((8, 1))))
        return cls(mesh=mesh, parts=tuple(parts), box=box, shading_mode=body.shading_mode)

    def only(self, chosen: Chosen) -> Any:
        """Return what is to be rendered of the triangles (T,) that are chosen."""
        body, first = sapien.render.RenderBodyComponent(), 0
        for part in self.parts:
            of_part = chosen[first : first + len(part.triangles)]
            first += len(part.triangles)
            if of_part.any():
                body.attach(part.only(of_part))
        body.shading_mode = self.shading_mode
        return body


DenseBodies = dict[str, DenseBody | None]
"""By name; None: not dense. Filled when a body is first drawn, and shared by all views of a simulator."""


def rendered(entity: Any) -> Any:
    """Return what is rendered of an entity, or None."""
    return entity.find_component_by_type(sapien.render.RenderBodyComponent)


def _parts(body: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the parts of a body's meshes, each with its shape."""
    for shape in body.render_shapes:
        for part in shape.parts:
            yield shape, part


def is_dense(entity: Any) -> bool:
    """Return whether a body is of many triangles, and can be made from arrays with the same pixels."""
    body = rendered(entity)
    if body is None:
        return False
    kind = sapien.render.RenderShapeTriangleMesh
    if not all(isinstance(one, kind) and one.front_face == FRONT for one in body.render_shapes):
        return False
    parts = [part for _, part in _parts(body)]
    # A map of normals needs tangents, which files have, and arrays have not.
    if any(part.material.normal_texture is not None for part in parts):
        return False
    return sum(len(part.triangles) for part in parts) >= DENSE
