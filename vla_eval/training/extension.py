"""Whether a training may have another number of steps than it was started with. Knows no models.

Of all that a step does, the learning rate alone may depend on the number of steps that follow: lerobot hands
it to the schedule and to nothing else.
"""

import json
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple  # Any: lerobot is untyped

import torch

from vla_eval.checkpoints.files import MODEL_FOLDER
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.errors import TrainingError
from vla_eval.training.job import TrainingJob
from vla_eval.training.run_folder import whole_checkpoints


class OtherRate(NamedTuple):
    """The first step, counted from 1, that would have had another learning rate."""

    step: int
    before: float
    now: float


def check_steps(job: TrainingJob, config: FinetuneConfig, before: int, done: int) -> None:
    """Refuse another number of steps than `before`, unless the steps done would have been the same."""
    asked = job.recipe.steps
    if asked < done:
        raise TrainingError(
            f"{job.out}: {done} steps are done, of {before}, and --steps {asked} asks for fewer. Ask for "
            f"{before}, or evaluate an earlier checkpoint in {job.out}/train/checkpoints."
        )
    other = first_other_rate(job.policy, before, asked, n_steps=done + 1)
    if other is None:
        return
    raise TrainingError(
        f"{job.out}: was started with --steps {before}, and {done} are done. With {asked} the learning rate "
        f"would have been another from step {other.step} on ({other.now:.3g}, not {other.before:.3g}): its "
        f"schedule depends on the number of steps, so this could not become the training of {asked} steps. "
        f"To train on from its weights, with a new optimizer and schedule, in a folder of its own:\n  "
        f"{_new_training(job, config, max(1, asked - done))}\nOr train all {asked} steps in another --out."
    )


def first_other_rate(policy: Any, before: int, now: int, *, n_steps: int) -> OtherRate | None:
    """Compare the schedules of two numbers of steps over the first `n_steps`; None: they begin alike."""
    pairs = zip(_rates(policy, before), _rates(policy, now), strict=False)
    for step, (rate, other) in zip(range(1, n_steps + 1), pairs, strict=False):
        if rate != other:
            return OtherRate(step, rate, other)
    return None


def _rates(policy: Any, n_steps: int) -> Iterator[float]:
    """Yield the learning rate of each step, without end."""
    preset = policy.get_scheduler_preset()
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=policy.get_optimizer_preset().lr)
    scheduler = None if preset is None else preset.build(optimizer, n_steps)
    while True:
        yield optimizer.param_groups[0]["lr"]
        optimizer.step()
        if scheduler is not None:
            scheduler.step()


def _new_training(job: TrainingJob, config: FinetuneConfig, steps: int) -> str:
    weights = whole_checkpoints(job.out)[-1] / MODEL_FOLDER
    out = next(path for n in range(2, 1000) if not (path := Path(f"{job.out}-{n}")).exists())
    flags: dict[str, object] = {"--policy": config.policy, "--dataset": config.dataset}
    flags |= {"--steps": steps, "--base-checkpoint": weights, "--run-seed": config.run_seed}
    flags |= {"--device": config.device, "--out": out}
    words = [str(word) for pair in flags.items() for word in pair]
    if config.allow_unreplayed:
        words.append("--allow-unreplayed")
    if config.held_out is not None:
        words += ["--held-out-every", str(config.held_out.every_steps)]
        words += ["--held-out-episodes", str(config.held_out.episodes)]
    own = {key: value for key, value in config.finetune.items() if key not in ("steps", "base_checkpoint")}
    for field, value in _leaves(own):
        words += ["--set", f"{field}={json.dumps(value)}"]
    return shlex.join(["mikasa-vla", "finetune", *words])


def _leaves(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in data.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
