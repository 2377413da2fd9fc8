"""Train an agent by rewards: a recipe and a task in, a run folder with checkpoints out.

The library does not store environments. So all of them begin new episodes after each checkpoint, and all
generators are seeded by run seed and step: a training that was killed continues as if it had not been.
"""

import functools
import gc
import inspect
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any  # the library's models

import numpy as np
import torch

from vla_eval.agents.checkpoints import load_checkpoint, write_checkpoint
from vla_eval.agents.curve import draw_curve
from vla_eval.agents.expert import Expert
from vla_eval.agents.job import AgentJob, agent_job
from vla_eval.agents.progress import Progress, quiet_logger
from vla_eval.agents.request import request_sha256
from vla_eval.agents.simulators import LOGS_FOLDER, simulators
from vla_eval.agents.vector_env import SlotsEnv
from vla_eval.config.agents import AgentConfig
from vla_eval.config.files import to_data
from vla_eval.errors import TrainingError
from vla_eval.policies.agents.algorithms import asked_of_library, library_class, network_class, network_fields
from vla_eval.seeding import global_generators_kept, seed_global_generators
from vla_eval.storage.provenance import collect_environment, package_version
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.objects.mesh_folder import without_path
from vla_eval.training.held_out import HeldOut
from vla_eval.training.request import FinetuneSummary, compared_fields
from vla_eval.training.run_folder import (
    LOCK_FILE,
    REQUEST_KEY,
    append_metrics,
    newest_step,
    open_folder,
    opened,
    read_metrics,
)

LIBRARIES = ("stable-baselines3", "sb3-contrib")
Say = Callable[[str], None]
"""Takes a line for a person."""


def train_agent(
    config: AgentConfig,
    *,
    command: str = "",
    say: Say = lambda _line: None,
    is_stopping: Callable[[], bool] = lambda: False,
) -> FinetuneSummary:
    """Train an agent, or resume its training.

    `is_stopping` is asked at each step; once it says yes, the training ends, and the same call resumes it
    from the last checkpoint.

    Raises:
        VlaEvalError: a mistake; what was saved stays.
    """
    job = agent_job(config)
    with opened(job.out, lambda: _open(job, command)) as resume_from:
        job = replace(job, resume_from=resume_from)
        say(f"run: {job.out}" + (f", resuming from step {job.first_step:,}" if resume_from else ""))
        held_out = _held_out(job, say, is_stopping)
        if held_out is not None:
            held_out.catch_up(read_metrics(job.out))
        if job.first_step < job.recipe.steps and not is_stopping():
            with global_generators_kept(), one_thread(job):
                _train(job, say, held_out, is_stopping)
        is_finished = newest_step(job.out) >= job.recipe.steps
        if held_out is not None and held_out.missing(read_metrics(job.out)):
            is_finished = False
        _draw(job)
    return FinetuneSummary(out=job.out, step=newest_step(job.out), is_finished=is_finished)


def _train(job: AgentJob, say: Say, held_out: HeldOut | None, is_stopping: Callable[[], bool]) -> None:
    with closing(environments(job, logs=job.out / LOGS_FOLDER)) as envs:
        model = make_model(job, envs)
        for line in described(job, model):
            say(line)
        if job.resume_from is not None:
            load_checkpoint(job.resume_from, model)
        progress = Progress(job, envs, say, is_stopping)
        model.set_logger(quiet_logger(progress, job.out / "tensorboard" if job.recipe.tensorboard else None))
        while model.num_timesteps < job.recipe.steps and not progress.was_stopped:
            if not _segment(job, model, envs, progress):
                return
            checkpoint = write_checkpoint(job, model)
            _draw(job)
            if held_out is not None and held_out.is_due(int(checkpoint.name)) and not is_stopping():
                held_out.evaluate(checkpoint)


def _segment(job: AgentJob, model: Any, envs: SlotsEnv, progress: Progress) -> bool:
    """Train up to the next checkpoint; whether it was reached."""
    first = model.num_timesteps
    seed_global_generators("agent", job.run_seed, first)
    envs.begin_segment(first)
    envs.action_space.seed(_seed(job, first))
    model.action_space.seed(_seed(job, first))
    model._last_obs = None  # the library then resets all environments
    if getattr(model, "_last_lstm_states", None) is not None:
        for states in (model._last_lstm_states.pi, model._last_lstm_states.vf):
            for state in states:
                state.zero_()
    goal = min(first + job.recipe.save_every_steps, job.recipe.steps)
    interval = job.recipe.n_envs if job.algorithm.replays else 1  # episodes, or updates
    try:
        model.learn(goal - first, callback=progress, log_interval=interval, reset_num_timesteps=False)
    except ValueError as exc:
        if not str(exc).startswith("Expected parameter"):  # torch's, of a distribution whose numbers are none
            raise
        raise _diverged(job, model) from exc
    if not all(bool(torch.isfinite(weight).all()) for weight in model.policy.parameters()):
        raise _diverged(job, model)
    return not progress.was_stopped


def _diverged(job: AgentJob, model: Any) -> TrainingError:
    return TrainingError(
        f"{job.out}: the network has diverged by step {model.num_timesteps:,}: its numbers are not finite. "
        "The checkpoints before are whole. Train with a lower train_agent.arguments.learning_rate, in "
        "another --out."
    )


def _seed(job: AgentJob, step: int) -> int:
    return int(np.random.SeedSequence([job.run_seed, step]).generate_state(1)[0]) >> 1


def make_model(job: AgentJob, envs: SlotsEnv) -> Any:
    """Return the library's model with its first weights, which are a function of the run seed."""
    seed_global_generators("agent's first weights", job.run_seed)
    row, recipe = job.algorithm, job.recipe
    arguments = dict(recipe.arguments)
    cls = library_class(row)
    if recipe.anneal_lr:
        rate = float(
            arguments.get("learning_rate", inspect.signature(cls).parameters["learning_rate"].default)
        )
        # by the steps that are done: the library's own measure starts again at each checkpoint
        arguments["learning_rate"] = lambda _progress: rate * (1 - _done(made, job))
    made: list[Any] = []
    with warnings.catch_warnings():
        # What `described` says.
        warnings.filterwarnings("ignore", "You have specified a mini-batch size", UserWarning)
        model = asked_of_library(
            lambda: cls(
                network_class(row),
                envs,
                policy_kwargs=network_fields(row, recipe.network),
                device=job.device,
                **arguments,
            ),
            where=f"policies/{job.name}.yaml, train_agent",
        )
    made.append(model)
    gc.freeze()  # what was imported meanwhile, too
    return model


def _done(made: list[Any], job: AgentJob) -> float:
    """Return which part of the training was done before the present update."""
    steps = made[0].num_timesteps - job.steps_per_update if made else 0
    return max(0, steps) / job.recipe.steps


def environments(job: AgentJob, *, logs: Path) -> SlotsEnv:
    """Return the environments of a training, side by side; processes of theirs write to `logs`."""
    env = simulators(
        job.settings,
        workers=job.workers,
        is_robot=not task_spec(job.task).is_base,
        logs=logs,
    )
    return SlotsEnv(
        env,
        job.reader,
        n_slots=job.recipe.n_envs,
        reward=job.recipe.reward,
        run_seed=job.run_seed,
        expert=Expert.of(job, env) if job.algorithm.imitates else None,
    )


@contextmanager
def one_thread(job: AgentJob) -> Iterator[None]:
    """Compute with one thread on a CPU: sums of small networks then do not depend on the machine's cores.

    What was imported is not searched for garbage meanwhile: ManiSkill collects some at each reset.
    """
    before = torch.get_num_threads()
    if job.device == "cpu":
        torch.set_num_threads(1)
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        torch.set_num_threads(before)


def described(job: AgentJob, model: Any) -> list[str]:
    """Return lines for a person: what is trained, and how much memory it takes."""
    n_weights = sum(weight.numel() for weight in model.policy.parameters())
    shapes = ", ".join(f"{name} {part.shape}" for name, part in model.observation_space.items())
    steps, recipe = job.recipe.steps, job.recipe
    agent = f"agent: {recipe.algorithm}, {n_weights:,} weights; given '{job.reader.mode}' ({shapes})"
    if job.algorithm.imitates:
        return [
            f"{agent}; {model.n_demonstrations:,} demonstrations",
            f"steps: {steps:,} gradient steps, each of {model.batch_size} demonstrations",
        ]
    lines = [
        f"{agent}; {recipe.reward} reward",
        f"steps: {steps:,} of {recipe.n_envs} environments, weights change every {job.steps_per_update:,}",
    ]
    if steps != job.asked_steps:
        lines[-1] += f" ({job.asked_steps:,} asked for, in whole updates)"
    batch, collected = int(model.batch_size), job.steps_per_update
    if not job.algorithm.replays and collected % batch:
        lines.append(f"note: the last batch of each pass has {collected % batch} of {batch} steps")
    n_bytes = _buffer_bytes(model)
    return [*lines, f"memory: {n_bytes / 1e6:,.0f} MB for collected steps"]


def _buffer_bytes(model: Any) -> int:
    buffer = getattr(model, "replay_buffer", None)
    if buffer is None:
        buffer = model.rollout_buffer
        buffer.reset()  # which makes its arrays
    found = 0
    for value in vars(buffer).values():
        for part in value.values() if isinstance(value, dict) else (value,):
            found += part.nbytes if isinstance(part, np.ndarray) else 0
    return found


def _draw(job: AgentJob) -> None:
    lines = list(read_metrics(job.out))
    draw_curve(job.out, lines, name=job.name, task=job.task, imitates=job.algorithm.imitates)


def _held_out(job: AgentJob, say: Say, is_stopping: Callable[[], bool]) -> HeldOut | None:
    if job.held_out is None:
        return None
    return HeldOut(
        settings=job.held_out,
        task=job.task,
        out=job.out,
        last_step=job.recipe.steps,
        on_metrics=functools.partial(append_metrics, job.out),
        say=say,
        is_stopping=is_stopping,
    )


def _open(job: AgentJob, command: str) -> Path | None:
    settings: dict[str, Any] = {  # Any: plain data
        "finetune": compared_fields(job.recipe),
        "task": job.task,
        "run_seed": job.run_seed,
    }
    record: dict[str, Any] = {  # Any: plain data
        "policy": job.name,
        "recipe_sha256": job.recipe_sha256,
        "tasks": [job.task],
        "observation": job.reader.mode,
        "env": to_data(without_path(job.settings.kwargs)),
        "environment": collect_environment(),
        "libraries": {name: package_version(name) for name in LIBRARIES},
        "command": command,
        REQUEST_KEY: request_sha256(job.recipe, job.task, run_seed=job.run_seed),
    }
    check = functools.partial(_check_steps, job)
    return open_folder(job.out, settings, record, check_steps=check, ignore=frozenset({LOCK_FILE}))


def _check_steps(job: AgentJob, before: int, done: int) -> None:
    """Refuse another number of steps where the steps done would have been others."""
    if job.recipe.steps < done:
        raise TrainingError(
            f"{job.out}: {done:,} steps are done, of {before:,}, and --steps {job.asked_steps:,} asks for "
            f"fewer. Ask for {before:,}, or evaluate an earlier checkpoint in {job.out}/train/checkpoints."
        )
    if job.recipe.anneal_lr:
        raise TrainingError(
            f"{job.out}: was started with --steps {before:,}, and its learning rate falls to zero by the "
            f"last of them (train_agent.anneal_lr), so that this could not become the training of "
            f"{job.recipe.steps:,}. Train in another --out."
        )
