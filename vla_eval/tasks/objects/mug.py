"""The mug of the shell game: built from primitives in code, or the YCB asset if it is installed.

Dimensions are those of the real object of YCB, `025_mug`: 0.117 x 0.093 x 0.081 m with its handle,
0.118 kg (YCB object set, table of object sizes). The mug is one hollow body: it can stand over a ball.
"""

import math
from pathlib import Path

import numpy as np
import sapien
from mani_skill import ASSET_DIR
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building import actors
from mani_skill.utils.building.actor_builder import ActorBuilder

from vla_eval.errors import MissingDependencyError

HEIGHT_M = 0.081
OUTER_RADIUS_M = 0.0465
WALL_M = 0.0035
HANDLE_REACH_M = 0.024
HANDLE_HEIGHT_M = 0.05
HANDLE_BAR_M = 0.008
N_WALL_SEGMENTS = 16
MASS_KG = 0.118
TERRACOTTA_RGBA = (0.76, 0.38, 0.24, 1.0)


def mug_boxes() -> list[tuple[sapien.Pose, list[float]]]:
    """Return (pose, half sizes) of wall and handle of an upright mug, origin in the middle of its height."""
    boxes = []
    radius = OUTER_RADIUS_M - WALL_M / 2
    half_width = (OUTER_RADIUS_M) * math.tan(math.pi / N_WALL_SEGMENTS)
    for k in range(N_WALL_SEGMENTS):
        angle = 2 * math.pi * k / N_WALL_SEGMENTS
        turn = [math.cos(angle / 2), 0, 0, math.sin(angle / 2)]
        centre = [radius * math.cos(angle), radius * math.sin(angle), 0]
        boxes.append((sapien.Pose(centre, turn), [WALL_M / 2, half_width, HEIGHT_M / 2]))
    bar, reach = HANDLE_BAR_M / 2, HANDLE_REACH_M
    for z in (-HANDLE_HEIGHT_M / 2 + bar, HANDLE_HEIGHT_M / 2 - bar):
        boxes.append((sapien.Pose([OUTER_RADIUS_M + reach / 2, 0, z]), [reach / 2, bar, bar]))
    grip = [bar, bar, HANDLE_HEIGHT_M / 2]
    boxes.append((sapien.Pose([OUTER_RADIUS_M + reach - bar, 0, 0]), grip))
    return boxes


# Without a gap: upside down, the mug must not show the ball through its bottom.
BOTTOM_RADIUS_M = OUTER_RADIUS_M - WALL_M / 2
BOTTOM_POSE = sapien.Pose([0, 0, -HEIGHT_M / 2 + WALL_M / 2], [math.sqrt(0.5), 0, math.sqrt(0.5), 0])


def mug_volume_m3() -> float:
    """Return the volume of the mug's material."""
    walls_and_handle = float(sum(np.prod([2 * half for half in halves]) for _, halves in mug_boxes()))
    return walls_and_handle + math.pi * BOTTOM_RADIUS_M**2 * WALL_M


def primitive_mug_builder(scene: ManiSkillScene) -> ActorBuilder:
    """Return a builder for a terracotta mug with the real mug's size and mass."""
    builder = scene.create_actor_builder()
    material = sapien.render.RenderMaterial(base_color=TERRACOTTA_RGBA) if scene.can_render() else None
    density = MASS_KG / mug_volume_m3()
    for pose, halves in mug_boxes():
        builder.add_box_collision(pose, halves, density=density)
        builder.add_box_visual(pose, halves, material=material)
    bottom = {"pose": BOTTOM_POSE, "radius": BOTTOM_RADIUS_M, "half_length": WALL_M / 2}
    builder.add_cylinder_collision(**bottom, density=density)
    builder.add_cylinder_visual(**bottom, material=material)
    return builder


def ycb_mug_builder(scene: ManiSkillScene) -> ActorBuilder:
    """Return a builder for YCB's `025_mug`.

    Raises:
        MissingDependencyError: the asset is not installed. Nothing is ever downloaded from here.
    """
    folder = Path(ASSET_DIR) / "assets" / "mani_skill2_ycb"
    if not (folder / "models" / "025_mug").is_dir():
        raise MissingDependencyError(
            f"mug='ycb' needs the YCB asset '025_mug', expected in {folder}. Install it with "
            "`python -m mani_skill.utils.download_asset ycb`, or use mug='primitive'."
        )
    return actors.get_actor_builder(scene, id="ycb:025_mug")
