"""For all tests: nothing is looked for on the Hugging Face Hub; workers fork from one server."""

import os

# Read when huggingface_hub is imported.
os.environ.setdefault("HF_HUB_OFFLINE", "1")

from vla_eval.worker_start import worker_context  # after the line above

# Whatever the first test of a process needs: what a server did not import, each worker would.
worker_context(
    preload=(
        "vla_eval.envs.maniskill",
        "vla_eval.policies.lerobot",
        "vla_eval.data.recording_worker",
        "vla_eval.data.replay_worker",
    )
)
