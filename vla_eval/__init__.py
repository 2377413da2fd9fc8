"""Evaluate vision-language-action policies on memory-intensive manipulation tasks.

Importing this package costs nothing: simulators, torch and lerobot are imported by the one
adapter that owns each of them. Start reading at `vla_eval.core`, then `vla_eval.rollout`.
"""

__version__ = "0.1.0"
