"""What a training would take: sizes, memory, and the time by a moment of it. Writes nothing."""

import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any  # the library's models

import numpy as np

from vla_eval.agents.expert import Expert
from vla_eval.agents.job import agent_job
from vla_eval.agents.train import described, environments, make_model, one_thread
from vla_eval.config.agents import AgentConfig
from vla_eval.seeding import global_generators_kept

MEASURED_SECONDS = 5.0


def describe_training(config: AgentConfig) -> list[str]:
    """Return lines for a person; the time is measured on this machine, now.

    Raises:
        VlaEvalError: what a training would refuse.
    """
    job = agent_job(config)
    with (
        global_generators_kept(),
        one_thread(job),
        tempfile.TemporaryDirectory() as logs,
        closing(environments(job, logs=Path(logs))) as envs,
    ):
        model = make_model(job, envs)
        lines = described(job, model)
        if envs.expert is not None:
            return [*lines, _demonstrations_take(model, envs.expert), f"run folder: {job.out}"]
        begun, n_steps = time.monotonic(), 0
        envs.reset()
        while time.monotonic() - begun < MEASURED_SECONDS:
            envs.step(np.stack([envs.action_space.sample() for _ in range(envs.num_envs)]))
            n_steps += envs.num_envs
    rate = n_steps / (time.monotonic() - begun)
    hours = job.recipe.steps / rate / 3600
    return [
        *lines,
        f"time: the environments do {rate:,.0f} steps/s here, so at least {hours:.2f} h; learning "
        "comes on top (the training says how long it takes after its first update)",
        f"run folder: {job.out}",
    ]


def _demonstrations_take(model: Any, expert: Expert) -> str:
    begun, n_acted = time.monotonic(), 0
    for batch in expert.demonstrations(model.n_demonstrations, noise=model.action_push):
        n_acted += len(batch)
        if time.monotonic() - begun > MEASURED_SECONDS:
            break
    minutes = (time.monotonic() - begun) / max(1, n_acted) * model.n_demonstrations / 60
    return (
        f"time: the demonstrations take {minutes:.1f} min here, again at each resume; how long gradient "
        "steps take the training says after the first ones"
    )
