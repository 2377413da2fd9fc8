"""Render the images of docs/tasks/*.md, docs/clutter.md and docs/meshes.md: what two cameras see of tasks.

Usage: .venv/bin/python scripts/task_images.py [DOCS_IMAGES_FOLDER [TASK… | clutter | meshes]]
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from PIL import Image

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.core import EpisodeStart, ObservationWindow
from vla_eval.envs.maniskill import ManiSkillEnv
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_oracle
from vla_eval.tasks.catalog import task_spec

CAMERAS = ("base_camera", "hand_camera")
# Steps of the phases: the cue, the delay, the reveal, the oracle on its way, and at its goal.
STEPS = {
    "RememberColor3-v0": (0, 5, 10, 16, 22),
    "RememberColor5-v0": (0, 5, 10, 16, 22),
    "RememberColor9-v0": (0, 5, 10, 16, 22),
    "RememberShape9-v0": (0, 5, 10, 16, 22),
    "RememberShapeAndColor3x3-v0": (0, 5, 10, 16, 22),
    "RememberObject9-v0": (0, 5, 10, 16, 22),
    "ShellGameTouch-v0": (0, 4, 5, 10, 16),
    "ShellGamePush-v0": (0, 4, 5, 14, 22),
    "ShellGamePick-v0": (0, 4, 5, 26, 38),
    "InterceptMedium-v0": (0, 8, 16, 24, 32),
    "InterceptGrabMedium-v0": (0, 8, 14, 20, 28),
    "RotateStrictPos-v0": (0, 12, 20, 28, 36),
    "TakeItBack-v0": (0, 6, 10, 14, 20),
    "BunchOfColors3-v0": (0, 5, 10, 24, 38),
    "SeqOfColors3-v0": (0, 5, 10, 20, 48),
    "ChainOfColors3-v0": (0, 5, 10, 20, 48),
}
SEED = 1
GAP_PX = 2
CLUTTER = "clutter"  # name of the image of tasks with things around them, at the start of the choice
CLUTTERED = {  # task -> how many things
    "RememberColor9-v0": 12,
    "ShellGameTouch-v0": 12,
    "InterceptMedium-v0": 8,
    "RotateStrictPos-v0": 12,
    "TakeItBack-v0": 12,
}
CLUTTERED_PX = 160
MESHES = "meshes"  # name of the image of nine meshes made by trimesh
OF_MESHES = "RememberObject9-v0"


def sheet_of(task: str, **kwargs: Any) -> np.ndarray:
    """Return the (H, W, 3) uint8 RGB sheet of a task: a column per step, base view over wrist view."""
    env = ManiSkillEnv(EnvSettings(task=task, kwargs=kwargs, cameras=CAMERAS, privileged=True))
    chunking = ChunkingSpec(n_action_steps=1)
    policy = make_oracle(
        PolicyContext(
            name="oracle", env=env.spec, chunking=chunking, n_candidates=task_spec(task).n_candidates({})
        )
    )
    policy.reset(
        [
            EpisodeStart(
                slot=0, task=task, seed=SEED, run=0, instruction="-", horizon_steps=env.spec.horizon_steps
            )
        ]
    )
    frame = env.reset({0: SEED}, render=True)[0].observation
    columns = []
    for step in range(STEPS[task][-1] + 1):
        if step in STEPS[task]:
            columns.append(np.concatenate([_framed(frame.images[camera]) for camera in CAMERAS]))
        action = policy.act(ObservationWindow(slot=0, frames=(frame,))).actions[0]
        wanted = frozenset({0}) if step + 1 in STEPS[task] else frozenset[int]()
        frame = env.step({0: action}, render=wanted)[0].observation
    return np.concatenate(columns, axis=1)


def cluttered(task: str) -> np.ndarray:
    """Return the (H, W, 3) uint8 RGB column of a task with things around it, base view over wrist view."""
    kwargs = {CLUTTER: CLUTTERED[task], "image_size": CLUTTERED_PX}
    env = ManiSkillEnv(EnvSettings(task=task, kwargs=kwargs, cameras=CAMERAS))
    result = env.reset({0: SEED}, render=True)[0]
    while result.status.phase != "response":
        result = env.step({0: env.hold_action(0)}, render=frozenset({0}))[0]
    env.close()
    return np.concatenate([_framed(result.observation.images[camera]) for camera in CAMERAS])


def of_meshes() -> np.ndarray:
    """Return the sheet of a task whose candidates are nine meshes in a folder."""
    with tempfile.TemporaryDirectory() as folder:
        for name, mesh in toys().items():
            mesh.export(Path(folder) / f"{name}.glb")
        return sheet_of(OF_MESHES, meshes=folder, image_size=CLUTTERED_PX)


def toys() -> dict[str, trimesh.Trimesh]:
    """Return name -> mesh, m, y up as in glTF: boxes, round things, and a corner, which is not convex."""
    make, turned = trimesh.creation, trimesh.transformations.rotation_matrix
    upright = make.box((0.012, 0.02, 0.028)).apply_translation((-0.014, 0.0, 0.02))
    corner = trimesh.util.concatenate([make.box((0.04, 0.02, 0.012)), upright])
    pill = make.capsule(radius=0.01, height=0.03).apply_transform(turned(np.pi / 2, (0, 1, 0)))
    shapes = {
        "ball": (make.icosphere(subdivisions=4, radius=0.018), (235, 120, 30)),
        "board": (make.box((0.042, 0.042, 0.008)), (255, 255, 255)),
        "brick": (make.box((0.05, 0.022, 0.018)), (170, 60, 45)),
        "cone": (make.cone(radius=0.02, height=0.045), (60, 150, 70)),
        "corner": (corner, (120, 80, 170)),
        "pill": (pill, (230, 230, 225)),
        "pillar": (make.cylinder(radius=0.012, height=0.05), (50, 90, 190)),
        "ring": (make.torus(major_radius=0.02, minor_radius=0.008), (240, 200, 40)),
        "washer": (make.annulus(r_min=0.01, r_max=0.025, height=0.012), (110, 115, 120)),
    }
    squares = np.kron(np.indices((8, 8)).sum(axis=0) % 2, np.ones((8, 8))) * 215 + 20
    for name, (mesh, rgb) in shapes.items():
        uv = (mesh.vertices[:, :2] - mesh.bounds[0, :2]) / mesh.extents[:2]
        image = Image.fromarray(squares.astype(np.uint8)) if name == "board" else None
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=(*rgb, 255), baseColorTexture=image)
        mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        mesh.apply_transform(turned(-np.pi / 2, (1, 0, 0)))
    return {name: mesh for name, (mesh, _) in shapes.items()}


def _framed(image: np.ndarray) -> np.ndarray:
    return np.pad(image, ((0, GAP_PX), (0, GAP_PX), (0, 0)), constant_values=255)


def main() -> None:
    """Write one PNG per task."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images")
    folder.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or (*STEPS, CLUTTER, MESHES):
        if name == MESHES:
            columns = [of_meshes()]
        else:
            columns = [cluttered(task) for task in CLUTTERED] if name == CLUTTER else [sheet_of(name)]
        sheet = cv2.cvtColor(np.concatenate(columns, axis=1), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / f"{name}.png"), sheet, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
