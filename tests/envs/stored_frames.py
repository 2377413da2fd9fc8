"""Digests of one frame per task, drawn with the whole mesh of the wrist camera.

They hold for one version of Mesa and one device: another may round a colour differently. To write them again,
after a change that is listed under *Results-affecting*:

    python tests/envs/stored_frames.py
"""

import hashlib
import json
import sys
from pathlib import Path
from typing import Literal

import numpy as np

from vla_eval.config.environment import EnvSettings, RenderSettings
from vla_eval.envs.factory import describe_device, make_env
from vla_eval.storage.provenance import mesa_version
from vla_eval.tasks.catalog import TASKS

STORED = Path(__file__).parents[1] / "golden" / "frames.json"
CAMERAS = ("base_camera", "hand_camera")
SEED = 1
N_STEPS = 8
ACTION = (0.4, -0.3, -0.2, 0.5, -0.5, 0.6, 0.0)  # moves the arm and turns the hand about each axis


def frame_digest(task: str, mesh: Literal["shipped", "whole"]) -> tuple[str, str]:
    """Return the name of the render device, and the digest of both images after some steps."""
    env = make_env(EnvSettings(task=task, cameras=CAMERAS, render=RenderSettings(wrist_mesh=mesh)))
    env.reset({0: SEED}, render=False)
    action = np.array(ACTION, np.float32)
    for step in range(1, N_STEPS + 1):
        drawn = frozenset({0}) if step == N_STEPS else frozenset[int]()
        result = env.step({0: action}, render=drawn)[0]
    device = dict(describe_device(env) or {})["render_device"]
    env.close()
    digest = hashlib.sha256()
    for camera in CAMERAS:
        digest.update(result.observation.images[camera].tobytes())
    return device, digest.hexdigest()


def main() -> int:
    """Write the digests."""
    devices, frames = set(), {}
    for task in sorted(TASKS):
        device, frames[task] = frame_digest(task, "whole")
        devices.add(device)
    (device,) = devices
    stored = {"mesa": mesa_version(), "render_device": device, "frames": frames}
    STORED.write_text(json.dumps(stored, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
