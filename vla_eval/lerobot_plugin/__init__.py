"""What LeRobot's own commands take from here: importing this package registers the environment `mikasa`.

Named by `--env.discover_packages_path=vla_eval.lerobot_plugin`, or found by itself where the
distribution of the folder `plugins/` is installed.
"""

from vla_eval.lerobot_plugin.environment import MikasaEnvConfig, MikasaGym

__all__ = ["MikasaEnvConfig", "MikasaGym"]
