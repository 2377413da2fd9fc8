"""The state `eef` as policies from scratch read it. Without torch."""

from vla_eval.features import STATE_NAMES

STATE = len(STATE_NAMES["eef"])  # position, two columns of a rotation matrix, gripper
POSITION_SCALE = 5.0  # metres of the workspace to numbers of about 1
SPACE = 3  # numbers of a position, and of the translation with which an action begins
