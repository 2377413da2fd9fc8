"""Render the image of `docs/robots.md`: ShellGameTouch with each robot that solves it.

A column per robot, from above: the view for people and the base camera while the cue is shown, then both
at the choice, and the wrist camera. Usage: .venv/bin/python scripts/robot_images.py [FILE]
"""

import sys

import cv2
import numpy as np

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import HUMAN_CAMERA, EnvSettings
from vla_eval.core import EpisodeStart, Observation, ObservationWindow
from vla_eval.envs.maniskill import ManiSkillEnv
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_oracle
from vla_eval.robots.find import robots
from vla_eval.tasks.catalog import family_of, task_spec

TASK, SEED = "ShellGameTouch-v0", 3
CUE_STEP, CHOICE_STEP = 0, 30
CAMERAS = ("base_camera", "hand_camera")
EDGE_PX, GAP_PX = 160, 3


def column(robot: str) -> np.ndarray:
    """Return the (H, W, 3) uint8 RGB views of an episode of the expert with one robot."""
    settings = EnvSettings(
        task=TASK,
        kwargs={"robot": robot, "image_size": EDGE_PX},
        cameras=CAMERAS,
        privileged=True,
        human_camera_stride=1,
    )
    env = ManiSkillEnv(settings)
    n_candidates = task_spec(TASK).n_candidates({})
    context = PolicyContext(
        name="oracle", env=env.spec, chunking=ChunkingSpec(n_action_steps=1), n_candidates=n_candidates
    )
    policy = make_oracle(context)
    start = EpisodeStart(slot=0, task=TASK, seed=SEED, run=0, instruction="-", horizon_steps=90)
    policy.reset([start])
    seen = env.reset({0: SEED}, render=True)[0].observation
    views = _views(seen, (HUMAN_CAMERA, "base_camera"))
    for step in range(1, CHOICE_STEP + 1):
        action = policy.act(ObservationWindow(slot=0, frames=(seen,))).actions[0]
        wanted = frozenset({0}) if step == CHOICE_STEP else frozenset[int]()
        seen = env.step({0: action}, render=wanted)[0].observation
    env.close()
    return np.concatenate([*views, *_views(seen, (HUMAN_CAMERA, *CAMERAS))])


def _views(seen: Observation, cameras: tuple[str, ...]) -> list[np.ndarray]:
    return [_framed(seen.images[camera]) for camera in cameras]


def _framed(image: np.ndarray) -> np.ndarray:
    """Return the middle of an image at the size of a cell, with a white border."""
    edge = min(image.shape[:2])
    if edge > EDGE_PX:  # the view for people is wide: its middle shows the robot
        cut = edge // 5
        image = cv2.resize(image[cut:-cut, cut:-cut], (EDGE_PX, EDGE_PX), interpolation=cv2.INTER_AREA)
    return np.pad(image, ((0, GAP_PX), (0, GAP_PX), (0, 0)), constant_values=255)


def main() -> None:
    """Write the PNG."""
    family = family_of(task_spec(TASK))
    solving = [a.name for a in robots().values() if family not in a.not_solved]
    sheet = np.concatenate([column(name) for name in solving], axis=1)
    file = sys.argv[1] if len(sys.argv) > 1 else "docs/images/robots.png"
    cv2.imwrite(file, cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
