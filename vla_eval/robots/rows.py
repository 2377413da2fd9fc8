"""The robots that ship, a row each."""

import numpy as np

from vla_eval.control_modes import CONTROL_MODES, EE_DELTA_POSE
from vla_eval.robots.arm import Arm, Gripper

# Arm of the official code (mikasa_tasks section 1): tool centre point at (-0.07, 0, 0.318), pointing down.
PANDA = Arm(
    name="panda_wristcam",
    agent="vla_eval.tasks.arm.robots:PandaWristCamSeen",
    uids=("panda_wristcam_seen", "panda_wristcam", "panda_wristcam_light"),
    description="Franka Emika Panda with a wrist camera: the paper's robot, and the default",
    joints=(*(f"joint{i}" for i in range(1, 8)), "finger1", "finger2"),
    arm_joints=tuple(range(7)),
    gripper=Gripper(closed=-0.01, opened=0.04),
    rest_qpos=(0.0, 0.0, 0.0, -2 * np.pi / 3, 0.0, 2 * np.pi / 3, np.pi / 4, 0.04, 0.04),
    base_m=(-0.615, 0.0, 0.0),
    actions=CONTROL_MODES,
)
# As close to the table as possible (from -1.00 m on they touch). The tool centre point is then at
# (-0.12, 0, 0.30), and the hand points 30 degrees down: pointing straight down it would not reach the cubes.
FETCH = Arm(
    name="fetch",
    agent="vla_eval.tasks.arm.fetch:FetchAtTable",
    uids=("fetch_at_table",),
    description="Fetch, standing still in front of the table: its arm and gripper alone are commanded",
    joints=(
        *("root_x", "root_y", "root_turn", "torso", "head_pan", "shoulder_pan", "head_tilt"),
        *("shoulder_lift", "upperarm_roll", "elbow", "forearm_roll", "wrist", "wrist_roll"),
        *("finger1", "finger2"),
    ),
    arm_joints=(5, 7, 8, 9, 10, 11, 12),
    gripper=Gripper(closed=-0.01, opened=0.05),
    rest_qpos=(0.0, 0.0, 0.0, 0.386, 0.0, 0.0, 0.0, -1.0106, 0.0, 1.3855, 0.0, 0.1487, 0.0, 0.05, 0.05),
    base_m=(-1.02, 0.0, -0.9),
    actions={EE_DELTA_POSE: CONTROL_MODES[EE_DELTA_POSE]},
    not_solved={
        **dict.fromkeys(
            ("BunchOfColors", "SeqOfColors", "ChainOfColors"),
            "it does not touch several cubes in time, some of which lie at the edge of its reach",
        ),
        **dict.fromkeys(
            ("ShellGameTouch", "ShellGamePush"),
            "the farther mugs are out of its reach with the tilt at which it holds its hand",
        ),
        **dict.fromkeys(
            ("ShellGamePick", "RotateLenient", "RotateStrict"),
            "its hand, which points 30 degrees down, stays above what it has to grasp",
        ),
        "Intercept": "the places from which it would have to push the ball are out of its reach",
        "TakeItBack": "the disc is out of its reach",
    },
)

ROWS = (PANDA, FETCH)
"""In the order in which they are listed."""
