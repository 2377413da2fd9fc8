"""Registers `--env.type=mikasa` with LeRobot, which imports distributions of such a name by itself."""

import vla_eval.lerobot_plugin  # noqa: F401  importing it registers
