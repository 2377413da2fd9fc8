"""A scripted motion of the arm during the delay: what the robot's own state has stored is lost.

To and fro along y, with the gripper closed on the way out and open on the way back. Knows no simulator.
"""

from typing import NamedTuple

CYCLE_STEPS = 10
AMPLITUDE = 0.5  # of the action space, [-1, 1]: 5 steps of it move the arm by about 10 cm
Y_DIMENSION = 1
GRIPPER_DIMENSION = -1


class Motion(NamedTuple):
    """The two numbers of an action that are not 0."""

    y: float
    gripper: float


def delay_motion(step: int, *, begins: int, ends: int) -> Motion | None:
    """Return the motion of a control step of the delay, [begins, ends), or None outside of it.

    As many steps lead out as back, so that the arm ends about where it was.
    """
    if not begins <= step < ends:
        return None
    cycle_begins = begins + (step - begins) // CYCLE_STEPS * CYCLE_STEPS
    half = min(CYCLE_STEPS, ends - cycle_begins) // 2
    since = step - cycle_begins
    if since < half:
        return Motion(AMPLITUDE, -1.0)
    return Motion(-AMPLITUDE if since < 2 * half else 0.0, 1.0)
