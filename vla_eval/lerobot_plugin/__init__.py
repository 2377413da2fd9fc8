"""The plug-in for LeRobot's own commands: importing this package registers `mikasa` and our families.

Named by `--env.discover_packages_path=vla_eval.lerobot_plugin`, or found by itself where the
distribution of the folder `plugins/` is installed.
"""

from vla_eval.lerobot_plugin.environment import MikasaEnvConfig, MikasaGym
from vla_eval.models.families import register_families

register_families()

__all__ = ["MikasaEnvConfig", "MikasaGym"]
