"""The plug-in for LeRobot's own commands: importing this package registers it with lerobot.

The environment `mikasa`, and the policies `memory` and `memoryless`.

Named by `--env.discover_packages_path=vla_eval.lerobot_plugin`, or found by itself where the
distribution of the folder `plugins/` is installed.
"""

import vla_eval.models.memory.configuration_memory  # noqa: F401  importing it registers
from vla_eval.lerobot_plugin.environment import MikasaEnvConfig, MikasaGym

__all__ = ["MikasaEnvConfig", "MikasaGym"]
