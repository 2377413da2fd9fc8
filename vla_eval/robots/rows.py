"""The robots that ship, a row each."""

from collections.abc import Mapping

import numpy as np

from vla_eval.control_modes import CONTROL_MODES, EE_DELTA_POSE, JOINT_DELTA_POS, JOINT_POS, joint_modes
from vla_eval.robots.arm import Arm, Chain, Gripper, Hinge

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


_BEHIND_THE_MUGS = "the mugs are pushed from behind, and behind the nearest ones the arm itself stands"
_IN_THE_LANE = dict.fromkeys(
    ("Intercept", "InterceptGrab"), "many balls roll through the place where the arm stands"
)
_QUARTER = np.pi / 2


def _small_arm(
    *,
    name: str,
    agent: str,
    description: str,
    joints: tuple[str, ...],
    gripper: Gripper,
    rest_qpos: tuple[float, ...],
    base_x_m: float,
    chain: Chain,
    not_solved: Mapping[str, str],
) -> Arm:
    """Return an arm on the table with five joints, too few for every pose of the hand, and one of its jaw.

    Absolute positions come first, as LeRobot commands these arms.
    """
    delta, absolute = joint_modes(joints[:-1], chain.low_rad, chain.high_rad)
    return Arm(
        name=name,
        agent=f"vla_eval.tasks.arm.small_arms:{agent}",
        uids=(f"{name}_at_table",),
        description=description,
        joints=joints,
        arm_joints=tuple(range(5)),
        gripper=gripper,
        rest_qpos=rest_qpos,
        base_m=(base_x_m, 0.0, 0.0),
        base_yaw_rad=_QUARTER,
        actions={JOINT_POS: absolute, JOINT_DELTA_POS: delta},
        chain=chain,
        not_solved={"ShellGamePush": _BEHIND_THE_MUGS, **_IN_THE_LANE, **not_solved},
    )


_SO100_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
# Of ManiSkill's `so100.urdf`. The tool centre point is 3 cm in front of the fixed jaw's tip: the jaws then
# pass a cube of 4 cm and a peg of 5 cm on both sides.
_SO100_CHAIN = Chain(
    hinges=(
        Hinge(origin_m=(0.0, -0.0452, 0.0165), rpy_rad=(1.5708, 0.0, 0.0), axis=(0.0, -1.0, 0.0)),
        Hinge(origin_m=(0.0, 0.1025, 0.0306), axis=(1.0, 0.0, 0.0)),
        Hinge(origin_m=(0.0, 0.11257, 0.028), axis=(1.0, 0.0, 0.0)),
        Hinge(origin_m=(0.0, 0.0052, 0.1349), rpy_rad=(-1.5708, 0.0, 0.0), axis=(1.0, 0.0, 0.0)),
        Hinge(origin_m=(0.0, -0.0601, 0.0), rpy_rad=(0.0, 1.5708, 0.0), axis=(0.0, 1.0, 0.0)),
    ),
    tool=Hinge(origin_m=(-0.02, -0.097, 0.0), rpy_rad=(_QUARTER, _QUARTER, 0.0), axis=(0.0, 0.0, 1.0)),
    low_rad=(-2.0, -1.5708, -1.5708, -1.8, -3.14159),
    high_rad=(2.0, 1.5708, 1.5708, 1.8, 3.14159),
    least_reach_m=0.1,
)
# So far back that the nearest mugs do not stand on it, and so near that it reaches the farthest.
SO100 = _small_arm(
    name="so100",
    agent="SO100AtTable",
    description="SO-100, LeRobot's arm with five joints and a gripper, on the table",
    joints=_SO100_JOINTS,
    # Up to 5 cm as measured with cubes between the jaws, beyond that the distance of the jaws' tips in the
    # same file less 12 mm.
    gripper=Gripper(
        joints=(-1,),
        closed=-1.1,
        opened=1.1,
        gaps_m=(
            *((-1.1, 0.0), (-0.92, 0.018), (-0.76, 0.027), (-0.5, 0.04)),
            *((-0.27, 0.05), (0.0, 0.07), (0.5, 0.1), (1.1, 0.126)),
        ),
    ),
    rest_qpos=(0.0, -0.8, 0.2, 1.75, _QUARTER, -0.05),
    base_x_m=-0.24,
    chain=_SO100_CHAIN,
    not_solved={
        "ShellGamePick": "its jaws, one of which swings, push the mug away instead of closing on the handle",
        **dict.fromkeys(
            ("RotateLenient", "RotateStrict"), "it does not come to rest while its jaws hold the peg"
        ),
    },
)

_KOCH_JOINTS = (*(f"joint_{i}" for i in range(1, 6)), "joint_6")
# Of ManiSkill's `follower_arm_v1.1.urdf`. The tool centre point is 2 cm in front of the fixed finger's tip.
_KOCH_CHAIN = Chain(
    hinges=(
        Hinge(origin_m=(0.0005, -0.067858, 0.041066), axis=(0.0, 0.0, -1.0)),
        Hinge(origin_m=(0.020713, 0.0, 0.015368), rpy_rad=(1.5707963, 0.0, 0.0), axis=(-1.0, 0.0, 0.0)),
        Hinge(
            origin_m=(-0.038026, -0.014951, 0.108424), rpy_rad=(-1.5707963, 0.0, 0.0), axis=(1.0, 0.0, 0.0)
        ),
        Hinge(
            origin_m=(-0.000251, -0.100502, 0.002641), rpy_rad=(-1.5707963, 0.0, 0.0), axis=(1.0, 0.0, 0.0)
        ),
        Hinge(origin_m=(0.019234, 0.00037, -0.044779), rpy_rad=(0.0, 0.0, -1.5707963), axis=(0.0, 0.0, -1.0)),
    ),
    tool=Hinge(origin_m=(0.012, 0.0, -0.065), rpy_rad=(np.pi, 0.0, _QUARTER), axis=(0.0, 0.0, 1.0)),
    low_rad=(-3.14159, 0.0, 0.0, -1.5, -3.14159),
    high_rad=(3.14159, 2.2, 3.05, 2.14159, 3.14159),
    least_reach_m=0.1,
)
# So far back that the outermost of nine cubes do not stand beside it.
KOCH = _small_arm(
    name="koch",
    agent="KochAtTable",
    description="Koch v1.1, the smaller arm with five joints and a gripper, on the table",
    joints=_KOCH_JOINTS,
    # The distance of the fingers' tips in the same file.
    gripper=Gripper(
        joints=(-1,),
        closed=0.0,
        opened=1.6,
        gaps_m=(
            *((0.0, 0.0), (0.2, 0.0125), (0.4, 0.023), (0.6, 0.0333)),
            *((0.8, 0.0433), (1.2, 0.0619), (1.6, 0.078)),
        ),
    ),
    rest_qpos=(0.0, 1.35, 0.5, 2.1, _QUARTER, 1.6),
    base_x_m=-0.25,
    chain=_KOCH_CHAIN,
    not_solved={
        "ShellGamePick": "its fingers, one of which swings, do not close on the handle",
        **dict.fromkeys(("RotateLenient", "RotateStrict"), "its fingers do not get around the peg"),
        "TakeItBack": "its fingers lose the cube on the way",
    },
)

XARM6 = Arm(
    name="xarm6",
    agent="vla_eval.tasks.arm.xarm6:XArm6AtTable",
    uids=("xarm6_at_table",),
    description="UFactory xArm 6 with a Robotiq 2F-85 gripper; its meshes are a download of ManiSkill",
    asset="xarm6",
    joints=(
        *(f"joint{i}" for i in range(1, 7)),
        *("left_outer_knuckle_joint", "left_inner_knuckle_joint"),
        *("right_outer_knuckle_joint", "right_inner_knuckle_joint"),
        *("left_inner_finger_joint", "right_inner_finger_joint"),
    ),
    arm_joints=tuple(range(6)),
    # The distance of the pads in the simulator; at 4 and 5 cm with a cube and a peg between them.
    gripper=Gripper(
        joints=(6, 8),
        closed=0.81,
        opened=0.0,
        gaps_m=(
            *((0.0, 0.0846), (0.162, 0.0698), (0.32, 0.05)),
            *((0.4655, 0.04), (0.648, 0.0175), (0.81, 0.0)),
        ),
    ),
    # The tool centre point is at (-0.07, 0, 0.318), pointing down, as the Panda's.
    rest_qpos=(0.0, -0.0017, -1.3846, 0.0, 1.3864, *(0.0,) * 7),
    base_m=(-0.55, 0.0, 0.0),
    actions={EE_DELTA_POSE: CONTROL_MODES[EE_DELTA_POSE]},
    not_solved={
        "Intercept": "the ball rolls on between its fingers, which the expert does not close far enough",
        **dict.fromkeys(
            ("RotateLenient", "RotateStrict"),
            "its fingers are driven one by one and drift with the peg: a blind arm often succeeds, too",
        ),
    },
)

# So near that it reaches the farthest mugs.
WIDOWX = Arm(
    name="widowx",
    agent="vla_eval.tasks.arm.widowx:WidowXAtTable",
    uids=("widowx_at_table",),
    description="Trossen WidowX 250 S, the arm of BridgeData; its meshes are a download of ManiSkill",
    asset="widowx250s",
    joints=(
        *("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"),
        *("left_finger", "right_finger"),
    ),
    arm_joints=tuple(range(6)),
    # The distance of the fingers' inner sides in the simulator: they do not close altogether.
    gripper=Gripper(closed=0.015, opened=0.037, gaps_m=((0.015, 0.0073), (0.037, 0.0512))),
    # Between the fingers, 1.6 cm above their lowest point.
    tool=Hinge(origin_m=(0.0, 0.0, 0.0), rpy_rad=(np.pi, -_QUARTER, 0.0), axis=(0.0, 0.0, 1.0)),
    rest_qpos=(0.0, 0.0204, -0.2177, 0.0, 1.768, 0.0, 0.037, 0.037),
    base_m=(-0.32, 0.0, 0.0),
    actions={EE_DELTA_POSE: CONTROL_MODES[EE_DELTA_POSE]},
    not_solved={
        **dict.fromkeys(
            ("BunchOfColors", "SeqOfColors", "ChainOfColors"),
            "it moves so slowly that seven cubes take longer than an episode",
        ),
        "ShellGamePick": "its fingers do not hold the mug by its handle",
        **_IN_THE_LANE,
        **dict.fromkeys(
            ("RotateLenient", "RotateStrict"), "its fingers open 5.1 cm, and the peg has a width of 5 cm"
        ),
    },
)

ROWS = (PANDA, FETCH, SO100, KOCH, XARM6, WIDOWX)
"""In the order in which they are listed."""
