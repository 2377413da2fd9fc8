"""Evaluate vision-language-action policies on memory-intensive manipulation tasks.

    import vla_eval

    run = vla_eval.evaluate(policy=["cue_blind", "oracle"], tasks="RememberColor3-v0", episodes=20)
    run.to_pandas()

Importing this package costs nothing: simulators, torch and lerobot are imported by the one
adapter that owns each of them. Start reading at `vla_eval.core`, then `vla_eval.rollout`.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_PLACES = {
    "Run": "run",
    "check_policy": "checking",
    "evaluate": "evaluating",
    "finetune": "finetuning",
    "list_policies": "listing",
    "list_tasks": "listing",
    "load_dataset": "recording",
    "load_run": "run",
    "make_env": "environments",
    "record": "recording",
    "run_probe": "probing",
}
"""Name -> its module in `vla_eval.api`, imported when it is first asked for; types: `__init__.pyi`."""


def __getattr__(name: str) -> Any:  # Any: a function or a class
    if name not in _PLACES:
        raise AttributeError(f"module 'vla_eval' has no attribute '{name}'")
    return getattr(importlib.import_module(f"vla_eval.api.{_PLACES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PLACES})
