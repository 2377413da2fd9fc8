"""A scene of its own for a camera, with the triangles that colour a pixel: the same image in half the time.

On a CPU, a small image takes as long as its triangles. Of 245,000 the arm has 225,000, and hardly one in ten
of these covers the centre of a pixel. They are found for each image (`pixel_cover`), and links are made of
them. Where the same ones are left as in the image before, as of links that are out of view, none is made:
SAPIEN would record its commands again, which takes as long as 15,000 triangles.
"""

from typing import Any  # SAPIEN and ManiSkill are untyped: their scenes, entities and components are Any here

import numpy as np
import sapien
from mani_skill.render import set_shader_pack

from vla_eval.core import ImageArray
from vla_eval.envs.dense_bodies import DenseBodies, DenseBody, is_dense, rendered
from vla_eval.envs.pixel_cover import Chosen, Lens, Matrix, covering

GROUND = "ground"
# Of a pose in the camera's frame (m, and entries of a rotation), at a focal length of 64 px: one as near as
# this to that of an earlier image moves a corner by less than half of `pixel_cover.MARGIN_PX`.
STILL = 1e-6
STILL_FOCAL_PX = 64
BOX_MARGIN_M = 0.002


class _Shown:
    """A body of the original scene, and its copy: of a dense body, of the triangles that were found last."""

    def __init__(self, entity: Any, dense: DenseBody | None) -> None:
        self.entity, self.dense = entity, dense
        self.copy: Any = None  # nothing of it is to be drawn
        self._body = rendered(entity)
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
        shown = rendered(self.copy)
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
        nothing = np.zeros_like(self._chosen)
        chosen = nothing if is_outside else covering(self.dense.mesh, view, lens)
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
        is_new = self._of is not env.scene
        if is_new:
            self._follow(env)
        if self._choose() or is_new:
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
            _Shown(one, dense.get(one.per_scene_id)) for one in whole.entities if rendered(one) is not None
        ]
        self._culled = [one for one in self._shown if one.dense is not None]
        self._boxes = np.array([one.dense.box for one in self._shown if one.dense is not None])
        self._added: list[Any] = []
        self._of = env.scene

    def _choose(self) -> bool:
        """Choose triangles of the dense bodies; return whether there are other copies now."""
        if not self._culled:
            return False
        to_camera = (self._original.entity.pose * self._original.local_pose).inv()
        views = np.stack([(to_camera * one.entity.pose).to_transformation_matrix() for one in self._culled])
        outside = _is_outside(self._boxes, views, self._lens)
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

        The ground only if the camera stays where it is: otherwise it would be made again for each image. None
        where a light casts shadows: what colours no pixel may cast one.
        """
        if any(light.shadow for light in env.scene.sub_scenes[0].render_system.lights):
            return {}
        bodies = {f"link {link.name}": link._objs[0].entity for link in env.agent.robot.links}
        if is_fixed and GROUND in env.scene.actors:
            bodies[GROUND] = env.scene.actors[GROUND]._objs[0]
        found = {}
        for name, entity in bodies.items():
            if name not in self._known:
                self._known[name] = DenseBody.of(rendered(entity)) if is_dense(entity) else None
            if (dense := self._known[name]) is not None:
                found[entity.per_scene_id] = dense
        return found


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
