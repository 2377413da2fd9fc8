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
    "Run": "vla_eval.api.run",
    "check_policy": "vla_eval.api.checking",
    "evaluate": "vla_eval.api.evaluating",
    "finetune": "vla_eval.api.finetuning",
    "list_policies": "vla_eval.api.listing",
    "list_tasks": "vla_eval.api.listing",
    "load_dataset": "vla_eval.api.recording",
    "load_run": "vla_eval.api.run",
    "make_env": "vla_eval.envs.gymnasium_env",
    "record": "vla_eval.api.recording",
    "run_probe": "vla_eval.api.probing",
}
"""Name -> its module, imported when it is first asked for; types: `__init__.pyi`."""


def __getattr__(name: str) -> Any:  # Any: a function or a class
    if name not in _PLACES:
        raise AttributeError(f"module 'vla_eval' has no attribute '{name}'")
    return getattr(importlib.import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PLACES})
