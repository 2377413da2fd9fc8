"""What may lie on the table in the Remember tasks: nine shapes from primitives, nine colours by name.

All shapes are about 4 cm wide, lie or stand at rest on the table, and have their origin where a hand would
aim. Sizes are those of the official code (S = 2 cm is its scale). Resting heights are such that nothing
drops when it is revealed. Knows nothing of phases or of which item is right.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor

from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.item_names import COLOR_RGB
from vla_eval.tasks.objects.limits import CubeHalfSize
from vla_eval.tasks.objects.solid_bodies import solid_builder
from vla_eval.tasks.objects.solids import Solid

S = 0.02  # m, the official scale: half the edge of a cube
BAR = 0.375 * S
Z_UP_WXYZ = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # cylinders and discs face x; turn them up


class NamedColor(NamedTuple):
    """A colour whose name describes how it looks."""

    name: str
    rgb: tuple[int, int, int]


COLORS = tuple(NamedColor(name, rgb) for name, rgb in COLOR_RGB.items())


@dataclass(frozen=True, slots=True, kw_only=True)
class Primitive:
    """One convex part: `size` is (half x, half y, half z), (radius,) or (radius, half length), in m."""

    kind: Literal["box", "sphere", "cylinder"]
    size: tuple[float, ...]
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orientation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    rgb: tuple[int, int, int] | None = None  # of this part, 0 to 255; None: the item's colour


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """Parts in the frame of the item, whose origin lies `rest_height_m` over the table."""

    name: str
    parts: tuple[Primitive, ...]
    rest_height_m: float
    solid: Solid | None = None  # a user's mesh, which then is all there is


def _about_z(angle_rad: float) -> tuple[float, float, float, float]:
    return (math.cos(angle_rad / 2), 0.0, 0.0, math.sin(angle_rad / 2))


def _ring(n_parts: int, angle_rad: float, part: Callable[[float], Primitive]) -> tuple[Primitive, ...]:
    step = angle_rad / n_parts
    return tuple(part(step * (k + 0.5)) for k in range(n_parts))


def _tube_part(angle_rad: float, *, half_length_m: float) -> Primitive:
    """Return a piece of a tube of radius S/2 whose centre line is on a circle of radius S."""
    along = _about_z(angle_rad + math.pi / 2)
    place = (S * math.cos(angle_rad), S * math.sin(angle_rad), 0.0)
    return Primitive(kind="cylinder", size=(S / 2, half_length_m), position_m=place, orientation_wxyz=along)


def _star_point(angle_rad: float) -> Primitive:
    place = (0.75 * S * math.cos(angle_rad), 0.75 * S * math.sin(angle_rad), 0.0)
    return Primitive(
        kind="box", size=(0.75 * S, BAR, BAR), position_m=place, orientation_wxyz=_about_z(angle_rad)
    )


CUBE_HALF_SIZE_M = S


def cube(half_size_m: float) -> Shape:
    """Return a cube of another size.

    Raises:
        TaskArgumentError: too small for the arm to aim at, or so large that neighbours would overlap.
    """
    limits.check(CubeHalfSize, cube_half_size_m=half_size_m)
    half = float(half_size_m)
    return Shape(name="cube", parts=(Primitive(kind="box", size=(half, half, half)),), rest_height_m=half)


TAU = 2 * math.pi
SHAPES = {
    shape.name: shape
    for shape in (
        cube(CUBE_HALF_SIZE_M),
        Shape(name="sphere", parts=(Primitive(kind="sphere", size=(S,)),), rest_height_m=S),
        Shape(
            name="cylinder",
            parts=(Primitive(kind="cylinder", size=(S, S), orientation_wxyz=Z_UP_WXYZ),),
            rest_height_m=S,
        ),
        Shape(
            name="cross",
            parts=(
                Primitive(kind="box", size=(1.5 * S, BAR, BAR)),
                Primitive(kind="box", size=(BAR, 1.5 * S, BAR)),
            ),
            rest_height_m=BAR,
        ),
        Shape(
            name="torus",
            parts=_ring(8, TAU, lambda a: _tube_part(a, half_length_m=S * math.tan(math.pi / 8))),
            rest_height_m=S / 2,
        ),
        Shape(name="star", parts=_ring(5, TAU, _star_point), rest_height_m=BAR),
        Shape(
            name="pyramid",
            parts=(
                Primitive(kind="box", size=(S, S, S / 4)),
                Primitive(kind="box", size=(0.7 * S, 0.7 * S, S / 4), position_m=(0, 0, S / 2)),
                Primitive(kind="box", size=(0.4 * S, 0.4 * S, S / 4), position_m=(0, 0, S)),
            ),
            rest_height_m=S / 4,
        ),
        Shape(
            name="t_shape",
            parts=(
                Primitive(kind="box", size=(S, BAR, BAR), position_m=(0, S - BAR, 0)),
                Primitive(kind="box", size=(BAR, S - BAR, BAR), position_m=(0, -BAR, 0)),
            ),
            rest_height_m=BAR,
        ),
        Shape(
            name="crescent",
            parts=_ring(12, math.pi, lambda a: _tube_part(a, half_length_m=S * math.tan(math.pi / 24))),
            rest_height_m=S / 2,
        ),
    )
}
"""In the official order. The official T stands upright on a foot of 1.5 cm; ours lies, and cannot topple."""


class Item(NamedTuple):
    """A shape in a colour, or in the colours of its parts."""

    shape: Shape
    color: NamedColor | None = None

    @property
    def name(self) -> str:
        """For example `red_cube`, or `banana`; a mesh may have the name of anything in the scene."""
        if self.shape.solid is not None:
            return f"mesh_{self.shape.name}"
        return f"{self.color.name}_{self.shape.name}" if self.color else self.shape.name

    def rgb_of(self, part: Primitive) -> tuple[int, int, int]:
        """Return the colour of a part, 0 to 255."""
        rgb = part.rgb or (self.color.rgb if self.color else None)
        assert rgb is not None, f"{self.name}: a part without a colour"
        return rgb


def build_item(scene: ManiSkillScene, item: Item, *, initial_pose: sapien.Pose) -> Actor:
    """Build the dynamic actor of an item."""
    builder = _item_builder(scene, item)
    builder.initial_pose = initial_pose
    return builder.build(name=item.name)


def build_fixed(scene: ManiSkillScene, item: Item, *, initial_pose: sapien.Pose) -> Actor:
    """Build a kinematic actor that looks like an item and stops what runs into it, as the table does."""
    builder = _item_builder(scene, item)
    builder.initial_pose = initial_pose
    return builder.build_kinematic(name=item.name)


def build_decoy(scene: ManiSkillScene, item: Item, *, initial_pose: sapien.Pose) -> Actor:
    """Build a kinematic actor that looks like an item and touches nothing."""
    builder = _item_builder(scene, item)
    builder.collision_records = []
    builder.hulls_m = []  # of a mesh
    builder.initial_pose = initial_pose
    return builder.build_kinematic(name=f"{item.name}_decoy")


def _item_builder(scene: ManiSkillScene, item: Item) -> Any:  # ManiSkill is untyped
    if item.shape.solid is not None:
        return solid_builder(scene, item.shape.solid)
    builder = scene.create_actor_builder()
    materials = {}  # one for all parts of a colour
    for part in item.shape.parts:
        rgb = item.rgb_of(part)
        if rgb not in materials and scene.can_render():
            rgba = [*(channel / 255 for channel in rgb), 1.0]
            materials[rgb] = sapien.render.RenderMaterial(base_color=rgba)
        material = materials.get(rgb)
        pose = sapien.Pose(list(part.position_m), list(part.orientation_wxyz))
        if part.kind == "box":
            builder.add_box_collision(pose, list(part.size))
            builder.add_box_visual(pose, list(part.size), material=material)
        elif part.kind == "sphere":
            builder.add_sphere_collision(pose, *part.size)
            builder.add_sphere_visual(pose, *part.size, material=material)
        else:
            radius, half_length = part.size
            builder.add_cylinder_collision(pose, radius, half_length)
            builder.add_cylinder_visual(pose, radius, half_length, material=material)
    return builder
