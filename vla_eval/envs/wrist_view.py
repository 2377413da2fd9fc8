"""A second scene for the wrist camera, without the arm behind it: the same pixels in half of the time.

On a CPU, a small image takes as long as its triangles, and 220,000 of 245,000 are the arm's. The wrist
camera sees its fingers and what lies on the table. Leaving the rest out of its image in the one scene makes
SAPIEN record its commands again for every image, which takes longer than drawing. Two scenes need it once.

What is left out is never in view: links that move with the camera cover no pixel of a wider view, drawn once;
the other links are checked for each image, and if the box of one may be in view, the whole scene is drawn.
"""

from collections.abc import Mapping
from typing import Any  # SAPIEN and ManiSkill are untyped: their scenes, entities and components are Any here

import numpy as np
import sapien
from mani_skill.render import set_shader_pack
from numpy.typing import NDArray

from vla_eval.core import ImageArray

WRIST_CAMERA = "hand_camera"
MARGIN_M = 0.002  # of the boxes
WIDER_RAD = 0.1  # than the camera's field of view, when it is asked whether it sees a link that moves with it
Corners = Mapping[str, NDArray[np.float64]]
"""Name of a link -> (8, 4) the corners of its box in its own frame, homogeneous."""


class WristView:
    """The wrist camera of one environment on the CPU, with one episode's scene at a time."""

    def __init__(self) -> None:
        self._corners: Corners = {}  # of links that move about the camera; the same for every scene
        self._carried: frozenset[str] = frozenset()  # links that move with the camera, and are never seen
        self._of: Any = None  # the scene that is drawn

    def submit(self, env: Any) -> bool:
        """Begin to draw the present image; return whether it can be drawn without the arm."""
        if self._of is not env.scene:
            self._follow(env)
        if self._may_be_seen(self._left_out):
            return False
        for entity, body, copy, shown in self._bodies:
            copy.pose = entity.pose
            if shown.visibility != body.visibility:
                shown.visibility = body.visibility
        self._camera.entity.pose = self._mount.pose
        self._scene.update_render()
        self._camera.take_picture()
        return True

    def image(self) -> ImageArray:
        """Return the (H, W, 3) image that was submitted last."""
        image: ImageArray = self._camera.get_picture("Color")[..., :3]
        return image

    def _follow(self, env: Any) -> None:
        """Make the scene that goes with a new one of the environment."""
        sensor = env.scene.sensors[WRIST_CAMERA]
        original = sensor.camera._render_cameras[0]
        links = {link.name: link._objs[0].entity for link in env.agent.robot.links}
        drawn = {name: entity for name, entity in links.items() if _body(entity) is not None}
        self._mount, self._local, self._tan = original.entity, original.local_pose, np.tan(original.fovy / 2)
        if self._of is None:
            carried = {name: drawn[name] for name in _carried(env, sensor.entity.name) if name in drawn}
            boxes = {name: _corners(drawn[name]) for name in drawn.keys() - carried.keys()}
            self._corners = {name: box for name, box in boxes.items() if box is not None}
            self._carried = frozenset(
                name for name, entity in carried.items() if not _sees(sensor.config, original, entity)
            )
        self._left_out = {
            name: drawn[name] for name in self._corners if not self._may_be_seen({name: drawn[name]})
        }
        without = {id(entity) for entity in self._left_out.values()} | {id(drawn[n]) for n in self._carried}
        self._scene = _scene_like(env.scene.sub_scenes[0])
        self._bodies = [
            (entity, body, *_copied(self._scene, entity))
            for entity in env.scene.sub_scenes[0].entities
            if (body := _body(entity)) is not None and id(entity) not in without
        ]
        self._camera = _camera_like(self._scene, sensor.config, original)
        self._of = env.scene

    def _may_be_seen(self, links: Mapping[str, Any]) -> bool:
        """Return whether the box of a link reaches into the view; False is certain."""
        if not links:
            return False
        view = (self._mount.pose * self._local).inv()
        poses = np.stack([(view * entity.pose).to_transformation_matrix() for entity in links.values()])
        corners = np.stack([self._corners[name] for name in links])
        seen_from_camera = np.moveaxis(corners @ poses.transpose(0, 2, 1), 2, 0)
        x, y, z, _ = seen_from_camera  # ahead, left, up; each (links, corners)
        edge = np.maximum(x, 0) * self._tan + MARGIN_M
        outside = [x < -MARGIN_M, y > edge, y < -edge, z > edge, z < -edge]
        return not np.stack(outside).all(axis=2).any(axis=0).all()


def _body(entity: Any) -> Any:
    """Return what is rendered of an entity, or None."""
    return entity.find_component_by_type(sapien.render.RenderBodyComponent)


def _carried(env: Any, mount: str) -> set[str]:
    """Return the names of the links that keep their distance to the link that the camera is mounted on."""
    fixed = [
        (link.name, link.joint.parent_link.name)
        for link in env.agent.robot.links
        if link.joint.parent_link is not None and link._objs[0].joint.type == "fixed"
    ]
    found = {mount}
    while more := {name for pair in fixed if found & set(pair) for name in pair} - found:
        found |= more
    return found


def _corners(entity: Any) -> NDArray[np.float64] | None:
    """Return (8, 4): the corners of the box around an entity's meshes, in its frame; None without meshes."""
    points = []
    for shape in _body(entity).render_shapes:
        if not isinstance(shape, sapien.render.RenderShapeTriangleMesh):
            return None
        frame = shape.local_pose.to_transformation_matrix()
        for part in shape.parts:
            points.append(part.vertices * shape.scale @ frame[:3, :3].T + frame[:3, 3])
    lowest, highest = np.vstack(points).min(axis=0), np.vstack(points).max(axis=0)
    chosen = np.indices((2, 2, 2)).reshape(3, 8).T
    return np.hstack((np.where(chosen, highest, lowest), np.ones((8, 1))))


def _sees(config: Any, original: Any, entity: Any) -> bool:
    """Return whether a pixel shows this entity, if nothing else is there and the view is a bit wider."""
    scene = sapien.Scene([sapien.render.RenderSystem(original.entity.scene.render_system.device)])
    copy, _ = _copied(scene, entity)
    copy.pose = entity.pose
    camera = _camera_like(scene, config, original)
    camera.set_fovy(original.fovy + WIDER_RAD, compute_x=True)
    camera.near = original.near / 2
    camera.entity.pose = original.entity.pose
    scene.update_render()
    camera.take_picture()
    return bool(camera.get_picture("PositionSegmentation")[..., 2].any())


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


def _copied(scene: Any, entity: Any) -> tuple[Any, Any]:
    """Add an entity to the scene that looks like another; return it and what is rendered of it."""
    copy, body = sapien.Entity(), _body(entity).clone()
    copy.add_component(body)
    scene.add_entity(copy)
    return copy, body


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
