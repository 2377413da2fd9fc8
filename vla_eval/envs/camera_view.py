"""A scene of its own for a camera, with the triangles that colour a pixel: the same image in half the time.

On a CPU, a small image takes as long as its triangles. Of 245,000 the arm has 225,000, and hardly one in ten
of these covers the centre of a pixel. They are found for each image (`pixel_cover`), and the arm's links are
made anew of them. Where the same ones are left as in the image before, as of links that are out of view, none
is made: SAPIEN would record its commands again, which takes as long as 15,000 triangles.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any  # SAPIEN and ManiSkill are untyped: their scenes, entities and components are Any here

import numpy as np
import sapien
from mani_skill.render import set_shader_pack
from numpy.typing import NDArray

from vla_eval.core import ImageArray
from vla_eval.envs.pixel_cover import Chosen, Floats, Lens, Matrix, Mesh, covering

DENSE = 5_000  # triangles of a body whose triangles are looked at one by one
GROUND = "ground"
# Of a pose in the camera's frame (m, and entries of a rotation), at a focal length of 64 px: one as near as
# this to that of an earlier image moves a corner by less than half of `pixel_cover.MARGIN_PX`.
STILL = 1e-6
STILL_FOCAL_PX = 64
BOX_MARGIN_M = 0.002


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


DenseBodies = dict[str, DenseBody]
"""By name; filled when a body is first drawn, and shared by all views of a simulator."""


class _Shown:
    """A body of the original scene, and its copy: of a dense body, of the triangles that were found last."""

    def __init__(self, entity: Any, dense: DenseBody | None) -> None:
        self.entity, self.dense = entity, dense
        self.copy: Any = None  # nothing of it is to be drawn
        self._body = _body(entity)
        if dense is None:
            self._copy_of(self._body.clone())
            return
        self._chosen: Chosen = np.zeros(len(dense.mesh.corners[0]), np.bool_)
        self._seen_from: Matrix | None = None  # the view for which they were chosen

    def follow(self) -> None:
        """Put the copy where the original is."""
        if self.copy is None:
            return
        self.copy.pose = self.entity.pose
        shown = _body(self.copy)
        if shown.visibility != self._body.visibility:
            shown.visibility = self._body.visibility

    def choose(self, view: Matrix, lens: Lens, *, is_outside: bool) -> bool:
        """Choose what colours a pixel in a view (4, 4), from the body's frame to the camera's.

        Returns:
            Whether that changed, so that there is another copy.
        """
        assert self.dense is not None
        still = STILL * STILL_FOCAL_PX / max(lens.focal_px)
        if self._seen_from is not None and np.abs(view - self._seen_from).max() <= still:
            return False
        self._seen_from = view
        chosen = self._chosen & False if is_outside else covering(self.dense.mesh, view, lens)
        if np.array_equal(chosen, self._chosen):
            return False
        self._chosen, self.copy = chosen, None
        if chosen.any():
            self._copy_of(self.dense.only(chosen))
        return True

    def _copy_of(self, body: Any) -> None:
        self.copy = sapien.Entity()
        self.copy.add_component(body)


class CameraView:
    """One camera of one environment on the CPU, with one episode's scene at a time."""

    def __init__(self, name: str, known: DenseBodies) -> None:
        self._name, self._known = name, known
        self._of: Any = None  # the scene that is drawn

    def submit(self, env: Any) -> None:
        """Begin to draw the present image."""
        if self._of is not env.scene:
            self._follow(env)
        if self._choose():
            self._arrange()
        for one in self._shown:
            one.follow()
        self._camera.entity.pose = self._original.entity.pose
        self._scene.update_render()
        self._camera.take_picture()

    def image(self) -> ImageArray:
        """Return the (H, W, 3) image that was submitted last."""
        image: ImageArray = self._camera.get_picture("Color")[..., :3]
        return image

    def _follow(self, env: Any) -> None:
        """Make the scene that goes with a new one of the environment."""
        sensor = env.scene.sensors[self._name]
        self._original = original = sensor.camera._render_cameras[0]
        self._lens = Lens(
            focal_px=(original.fx, original.fy),
            centre_px=(original.cx, original.cy),
            size_px=(original.width, original.height),
            near_m=original.near,
        )
        whole = env.scene.sub_scenes[0]
        self._scene = _scene_like(whole)
        self._camera = _camera_like(self._scene, sensor.config, original)
        dense = self._dense(env, is_fixed=sensor.entity is None)
        self._shown = [
            _Shown(one, dense.get(one.per_scene_id)) for one in whole.entities if _body(one) is not None
        ]
        self._culled = [one for one in self._shown if one.dense is not None]
        self._added: list[Any] = []
        self._arrange()
        self._of = env.scene

    def _choose(self) -> bool:
        """Choose triangles of the dense bodies; return whether there are other copies now."""
        if not self._culled:
            return False
        to_camera = (self._original.entity.pose * self._original.local_pose).inv()
        views = np.stack([(to_camera * one.entity.pose).to_transformation_matrix() for one in self._culled])
        outside = _is_outside(
            np.stack([one.dense.box for one in self._culled if one.dense]), views, self._lens
        )
        changed = [
            one.choose(view, self._lens, is_outside=bool(is_outside))
            for one, view, is_outside in zip(self._culled, views, outside, strict=True)
        ]
        return any(changed)

    def _arrange(self) -> None:
        """Add all copies in the order of their originals: of surfaces at one depth, the first is seen."""
        for entity in self._added:
            self._scene.remove_entity(entity)
        self._added = [one.copy for one in self._shown if one.copy is not None]
        for entity in self._added:
            self._scene.add_entity(entity)

    def _dense(self, env: Any, *, is_fixed: bool) -> dict[int, DenseBody]:
        """Return the bodies with many triangles, by the numbers of their entities.

        The ground only if the camera stays where it is: otherwise it would be made anew for each image.
        """
        bodies = {f"link {link.name}": link._objs[0].entity for link in env.agent.robot.links}
        if is_fixed and GROUND in env.scene.actors:
            bodies[GROUND] = env.scene.actors[GROUND]._objs[0]
        found = {}
        for name, entity in bodies.items():
            if name not in self._known and _is_dense(entity):
                self._known[name] = DenseBody.of(_body(entity))
            if name in self._known:
                found[entity.per_scene_id] = self._known[name]
        return found


def _body(entity: Any) -> Any:
    """Return what is rendered of an entity, or None."""
    return entity.find_component_by_type(sapien.render.RenderBodyComponent)


def _parts(body: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the parts of a body's meshes, each with its shape."""
    for shape in body.render_shapes:
        for part in shape.parts:
            yield shape, part


def _is_dense(entity: Any) -> bool:
    """Return whether a body is of many triangles, and can be made anew from arrays with the same pixels."""
    body = _body(entity)
    if body is None:
        return False
    kind = sapien.render.RenderShapeTriangleMesh
    if not all(isinstance(one, kind) and one.front_face == "counterclockwise" for one in body.render_shapes):
        return False
    parts = [part for _, part in _parts(body)]
    # A map of normals needs tangents, which files have, and arrays have not.
    if any(part.material.normal_texture is not None for part in parts):
        return False
    return sum(len(part.triangles) for part in parts) >= DENSE


def _is_outside(boxes: Matrix, views: Matrix, lens: Lens) -> Chosen:
    """Return (N,) bool: whether boxes (N, 8, 4), seen by (N, 4, 4), are out of view; True is certain."""
    x, y, z, _ = np.moveaxis(boxes @ views.transpose(0, 2, 1), 2, 0)  # ahead, left, up; each (N, 8)
    ahead = np.maximum(x, 0)
    (fx, fy), (cx, cy), (width, height) = lens.focal_px, lens.centre_px, lens.size_px
    outside = [
        x < -BOX_MARGIN_M,
        y > ahead * cx / fx + BOX_MARGIN_M,
        y < -ahead * (width - cx) / fx - BOX_MARGIN_M,
        z > ahead * cy / fy + BOX_MARGIN_M,
        z < -ahead * (height - cy) / fy - BOX_MARGIN_M,
    ]
    found: Chosen = np.any(np.all(np.stack(outside), axis=2), axis=0)
    return found


def _scene_like(original: Any) -> Any:
    """Return a scene with the same lights, in their order, and nothing in it."""
    system = original.render_system
    scene = sapien.Scene([sapien.render.RenderSystem(system.device)])
    scene.render_system.ambient_light = system.ambient_light
    for light in system.lights:
        copied, entity = type(light)(), sapien.Entity()
        copied.color, copied.shadow, copied.local_pose = light.color, light.shadow, light.local_pose
        entity.add_component(copied)
        entity.pose = light.entity.pose
        scene.add_entity(entity)
    return scene


def _camera_like(scene: Any, config: Any, original: Any) -> Any:
    set_shader_pack(config.shader_config)
    camera = sapien.render.RenderCameraComponent(original.width, original.height)
    camera.set_focal_lengths(original.fx, original.fy)
    camera.set_principal_point(original.cx, original.cy)
    camera.near, camera.far, camera.local_pose = original.near, original.far, original.local_pose
    entity = sapien.Entity()
    entity.add_component(camera)
    scene.add_entity(entity)
    return camera
