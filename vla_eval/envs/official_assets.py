"""What official tasks read of assets that are not in the package's wheel, and stand-ins for them.

The mug of the shell games is YCB's `025_mug`. ManiSkill looks for it in its own folder. The stand-in is
written into this package's cache, and the modules that read the asset are given that folder; ManiSkill's
folder is not touched, so that no other task takes it for the YCB object set. The light bulb of the lamps is
a file beside the package's code that its wheel 1.0.0 lacks.
"""

import functools
import importlib
import json
import sys
from pathlib import Path
from typing import Any  # trimesh and ManiSkill's modules are untyped

import numpy as np
import sapien
import trimesh as trimesh_library
from mani_skill import ASSET_DIR
from mani_skill.utils.building.actors import ycb

from vla_eval.envs.official_settings import BULB, Bulb, Mug
from vla_eval.errors import MissingDependencyError
from vla_eval.storage.cache import cached
from vla_eval.storage.drafts import appearing
from vla_eval.tasks.objects.mug import (
    BOTTOM_POSE,
    BOTTOM_RADIUS_M,
    HEIGHT_M,
    MASS_KG,
    TERRACOTTA_RGBA,
    WALL_M,
    mug_boxes,
    mug_volume_m3,
)

trimesh: Any = trimesh_library  # half of its functions have no types
ASSET = "025_mug"
FOLDER = "assets/mani_skill2_ycb"
READERS = "mikasa_robo_suite."

SHAPES, LAMP_MAKER = "mikasa_robo_suite.vla.utils.shapes", "build_color_switch_lamp"
BULB_FILE = Path("objects") / "low_poly_light_bulb.glb"  # beside the module
# Of the lamp maker: how its file is scaled and lowered, and the radius of the bulb's collision shape.
BULB_SCALE, BULB_LOWERED_M, BULB_RADIUS_M = 0.85, 0.07, 0.012


def provide_mug(mug: Mug, *, task: str) -> str:
    """Make the files of a mug, `ycb` or `stand_in`, findable; return what it is, for the run."""
    if mug == "stand_in":
        _read_from(_stand_in())
        return "stand-in of this package, not the YCB object"
    _read_from(ASSET_DIR)
    if not (ASSET_DIR / FOLDER / "models" / ASSET).is_dir():
        raise MissingDependencyError(
            f"{task} needs the YCB asset '{ASSET}', expected in {ASSET_DIR / FOLDER}. Install it with "
            "`python -m mani_skill.utils.download_asset ycb`, or use a mug of the same size made by this "
            "package: --set env.mug=stand_in."
        )
    return f"YCB {ASSET}"


def provide_bulb(bulb: Bulb, *, task: str) -> str:
    """Let lamps be made with the file `package`, or with a `stand_in`; return which it is, for the run."""
    shapes: Any = importlib.import_module(SHAPES)
    make: Any = getattr(shapes, LAMP_MAKER)
    make = getattr(make, "func", make)  # as the package has it
    if bulb == "stand_in":
        setattr(shapes, LAMP_MAKER, functools.partial(make, bulb_asset_path=str(_stand_in_bulb())))
        return "stand-in of this package: a sphere"
    setattr(shapes, LAMP_MAKER, make)
    file = Path(shapes.__file__).parent / BULB_FILE
    if not file.is_file():
        raise MissingDependencyError(
            f"{task} draws a lamp, and expects its light bulb in {file}, which the wheel of the package "
            f"lacks. Put the file there, or use a sphere of this package: --set env.{BULB}=stand_in."
        )
    return "the package's"


def _stand_in_bulb() -> Path:
    """Return a sphere where the lamp maker expects the bulb in its file, y up; write it if need be."""
    root = cached("official_bulb")
    file = root / BULB_FILE.name
    if not file.is_file():
        sphere = trimesh.creation.icosphere(subdivisions=3, radius=BULB_RADIUS_M / BULB_SCALE)
        sphere.apply_translation((0, BULB_LOWERED_M / BULB_SCALE, 0))
        with appearing(root) as draft:
            sphere.export(draft / file.name)
    return file


def _read_from(root: Path) -> None:
    """Let ManiSkill and the official tasks read assets from another folder."""
    readers: list[Any] = [ycb]
    readers += [module for name, module in sys.modules.items() if name.startswith(READERS)]
    for module in readers:
        if hasattr(module, "ASSET_DIR"):
            module.ASSET_DIR = root


def _stand_in() -> Path:
    """Return the folder that stands in for ManiSkill's; write it if it is not there."""
    root = cached("official_mug")
    if root.is_dir():
        return root
    parts = [_placed(trimesh.creation.box(2 * np.asarray(halves)), pose) for pose, halves in mug_boxes()]
    parts.append(_placed(_bottom(), BOTTOM_POSE))
    # Each connected part becomes one convex collision shape.
    whole = trimesh.util.concatenate(parts)
    colour = np.round(np.asarray(TERRACOTTA_RGBA) * 255).astype(np.uint8)
    material = trimesh.visual.material.SimpleMaterial(diffuse=colour)
    half = HEIGHT_M / 2
    low, high = whole.bounds[0].tolist(), whole.bounds[1].tolist()
    facts = {
        ASSET: {
            "bbox": {"min": [*low[:2], -half], "max": [*high[:2], half]},
            "scales": [1.0],
            "density": MASS_KG / mug_volume_m3(),
        }
    }
    with appearing(root) as draft:
        models = draft / FOLDER / "models" / ASSET
        models.mkdir(parents=True)
        whole.export(models / "collision.ply")
        whole.visual = trimesh.visual.TextureVisuals(material=material)
        whole.export(models / "textured.obj")
        (draft / FOLDER / "info_pick_v0.json").write_text(json.dumps(facts), encoding="utf-8")
    return root


def _bottom() -> Any:
    # Along z in trimesh, along x in SAPIEN.
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0))
    cylinder = trimesh.creation.cylinder(radius=BOTTOM_RADIUS_M, height=WALL_M)
    cylinder.apply_transform(turn)
    return cylinder


def _placed(mesh: Any, pose: sapien.Pose) -> Any:
    mesh.apply_transform(pose.to_transformation_matrix())
    return mesh
