"""Solids as actors of ManiSkill, made in memory: no file is written, and SAPIEN reads none."""

from typing import Any  # ManiSkill is untyped

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building.actor_builder import ActorBuilder

from vla_eval.core import FloatArray
from vla_eval.tasks.objects.solids import Solid, Surface

TEXTURE_FORMAT = "R8G8B8A8Unorm"
# As friction does of a real ball: one of flat triangles, put on a corner, otherwise rolls for up to 15 mm,
# with it for up to 5 mm (measured with icospheres of 320 to 5,120 triangles).
ROLLING_DAMPING_PER_S = 20.0
SAME_SIZE = np.ones(3, dtype=np.float32)


class _SolidBuilder(ActorBuilder):  # type: ignore[misc]  # untyped
    """Builds bodies of convex hulls and surfaces, besides what ManiSkill's builder has."""

    def __init__(self) -> None:
        super().__init__()
        self.hulls_m: list[FloatArray] = []
        self.surfaces: tuple[Surface, ...] = ()

    def build_entity(self) -> Any:
        """Return one of the bodies, with shapes of its own: a shape is part of one body."""
        self._procedural_shapes = [_seen(one) for one in self.surfaces] if self.scene.can_render() else []
        return super().build_entity()

    def build_physx_component(self, link_parent: Any = None) -> Any:
        """Return the body, with its hulls, whose density is ManiSkill's default, 1,000 kg/m³."""
        component = super().build_physx_component(link_parent)
        for hull_m in self.hulls_m:
            material = sapien.physx.get_default_material()
            shape = sapien.physx.PhysxCollisionShapeConvexMesh(
                vertices=hull_m, scale=SAME_SIZE, material=material
            )
            shape.set_collision_groups(self.collision_groups)
            component.attach(shape)
        component.angular_damping = ROLLING_DAMPING_PER_S
        return component


def _seen(surface: Surface) -> Any:
    """Return the shape that draws a surface."""
    material = sapien.render.RenderMaterial(base_color=[*(c / 255 for c in surface.rgb), 1.0])
    if surface.texture is not None:
        # The first row of an image is its top, and v counts from the bottom.
        texture = np.ascontiguousarray(surface.texture[::-1])
        material.base_color_texture = sapien.render.RenderTexture2D(texture, TEXTURE_FORMAT, srgb=True)
    return sapien.render.RenderShapeTriangleMesh(
        vertices=surface.vertices_m,
        triangles=surface.triangles,
        normals=surface.normals,
        uvs=surface.uvs,
        material=material,
    )


def solid_builder(scene: ManiSkillScene, solid: Solid) -> ActorBuilder:
    """Return a builder for a body that looks and touches like a solid."""
    builder = _SolidBuilder()
    builder.set_scene(scene)
    builder.hulls_m, builder.surfaces = [solid.hull_m], solid.surfaces
    return builder
