"""A task in another look: its lights, its base camera, its colours. Physics, places and draws are the same.

Only what is rendered is changed, after the task has built its scene. Knows nothing of what is shown or right.
"""

import colorsys
import math
from collections.abc import Iterator
from typing import Any  # ManiSkill is untyped: its classes, actors and materials are Any here

import sapien
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs import Pose

from vla_eval.config.environment import AS_DESIGNED, AppearanceSettings

MOVED_CAMERA = "base_camera"  # the other one is a part of the robot
FURNITURE = ("table-workspace", "ground")
# Of ManiSkill's table, in x and y (`TableSceneBuilder`: the bounding box in its comments).
TABLE_HALF_SIZE_M = (0.6045, 1.2089)
TABLE_CENTRE_M = (-0.1357, -0.0059)
TOP_M = 0.0005  # thinner than the discs of some tasks lie high


def with_appearance(cls: Any, appearance: AppearanceSettings) -> Any:
    """Return the class of a task that looks like this; the class itself if nothing is changed."""
    if appearance == AS_DESIGNED:
        return cls
    return type(cls.__name__, (_Appearance, cls), {"appearance": appearance, "__module__": cls.__module__})


class _Appearance:
    """What comes before a task's class: it calls the task's methods, then changes what is rendered."""

    appearance: AppearanceSettings

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        configs: list[CameraConfig] = super()._default_sensor_configs  # type: ignore[misc]  # the task's
        for config in configs:
            if config.uid == MOVED_CAMERA:
                config.pose = Pose.create(self._moved(config.pose.sp))
        return configs

    def _moved(self, pose: sapien.Pose) -> sapien.Pose:
        half = math.radians(self.appearance.camera_turn_deg) / 2
        turn = sapien.Pose(q=[math.cos(half), 0, 0, math.sin(half)])
        x, y, z = pose.p
        at_place = sapien.Pose(p=[x, y + self.appearance.camera_shift_m, z])
        return at_place * turn * sapien.Pose(q=pose.q)

    def _load_lighting(self, options: dict[str, Any]) -> None:
        super()._load_lighting(options)  # type: ignore[misc]  # the task's
        for scene in self.scene.sub_scenes:  # type: ignore[attr-defined]  # the task's
            system = scene.render_system
            system.ambient_light = system.ambient_light * self.appearance.light
            for light in system.get_lights():
                light.color = light.color * self.appearance.light

    def _load_scene(self, options: dict[str, Any]) -> None:
        super()._load_scene(options)  # type: ignore[misc]  # the task's
        if not self.scene.can_render():  # type: ignore[attr-defined]  # the task's
            return
        for name, actor in self.scene.actors.items():  # type: ignore[attr-defined]  # the task's
            for material in () if name in FURNITURE else _materials(actor):
                red, green, blue, alpha = material.base_color
                turned = turned_hue((red, green, blue), self.appearance.hue_deg)
                material.base_color = [*turned, alpha]
        if self.appearance.table_rgb is not None:
            for scene in self.scene.sub_scenes:  # type: ignore[attr-defined]  # the task's
                scene.add_entity(_plain_top(self.appearance.table_rgb))


def _plain_top(rgb: tuple[float, ...]) -> sapien.Entity:
    """Return a sheet that is only rendered: all scenes of the process share the table's own material."""
    material = sapien.render.RenderMaterial(base_color=[*rgb, 1.0])
    body = sapien.render.RenderBodyComponent()
    body.attach(sapien.render.RenderShapeBox([*TABLE_HALF_SIZE_M, TOP_M / 2], material))
    entity = sapien.Entity()
    entity.name = "table_top"
    entity.add_component(body)
    entity.set_pose(sapien.Pose(p=[*TABLE_CENTRE_M, TOP_M / 2]))
    return entity


def turned_hue(rgb: tuple[float, float, float], degrees: float) -> tuple[float, float, float]:
    """Return a colour of the same saturation and value whose hue is so much further; grey stays grey."""
    hue, saturation, value = colorsys.rgb_to_hsv(*rgb)
    return colorsys.hsv_to_rgb((hue + degrees / 360) % 1, saturation, value)


def _materials(actor: Any) -> Iterator[Any]:
    """Yield the materials of an actor; without a renderer there is none."""
    for entity in actor._objs:
        body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        for shape in body.render_shapes if body is not None else ():
            for part in getattr(shape, "parts", (shape,)):
                yield part.material
