"""Render the images of `docs/tasks/*.md` and `docs/clutter.md`: what the two cameras see of each task.

Usage: .venv/bin/python scripts/task_images.py [DOCS_IMAGES_FOLDER [TASK… | clutter]]
"""

import sys
from pathlib import Path

import cv2
import numpy as np

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


def picture(task: str) -> np.ndarray:
    """Return the (H, W, 3) uint8 RGB sheet of a task: a column per step, base view over wrist view."""
    env = ManiSkillEnv(EnvSettings(task=task, cameras=CAMERAS, privileged=True))
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


def _framed(image: np.ndarray) -> np.ndarray:
    return np.pad(image, ((0, GAP_PX), (0, GAP_PX), (0, 0)), constant_values=255)


def main() -> None:
    """Write one PNG per task."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images")
    folder.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or (*STEPS, CLUTTER):
        columns = [cluttered(task) for task in CLUTTERED] if name == CLUTTER else [picture(name)]
        sheet = cv2.cvtColor(np.concatenate(columns, axis=1), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / f"{name}.png"), sheet, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
