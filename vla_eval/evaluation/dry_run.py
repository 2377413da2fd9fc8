"""`eval --dry-run`: what would run, and what it takes. Starts no worker and writes nothing."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vla_eval.checkpoints.files import find_checkpoint, weights_file
from vla_eval.checkpoints.notes import CHECKPOINTS, LEROBOT_CHECKPOINTS
from vla_eval.config.evaluation import EvalConfig, may_be_wanted
from vla_eval.evaluation.episode_jobs import EpisodeJob
from vla_eval.evaluation.evaluate import describe, worker_count
from vla_eval.evaluation.job_queue import JobQueue
from vla_eval.evaluation.plan import Plan, make_plan
from vla_eval.evaluation.resolve import ResolvedEvaluation
from vla_eval.policies.entries import PolicyEntry
from vla_eval.policies.registry import SCRIPTED
from vla_eval.policies.remote.settings import ADAPTER as REMOTE_ADAPTER
from vla_eval.storage.run_folder import check_startable

N_CAMERAS = 2
LEARNED = "checkpoint"  # the argument of adapters that load weights
GB = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class AssumedRates:
    """What is assumed of one worker on a CPU (docs/speed.md), and of an inference of a learned policy."""

    steps_per_second: float = 500.0  # without images; resets are in it
    frames_per_second: float = 50.0  # images of one camera
    inference_seconds: float = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationEffort:
    """What is left of an evaluation; steps, inferences and frames at most, as if no episode ended early."""

    n_episodes: int
    n_finished: int  # episodes that have a result
    n_steps: int
    n_inferences: int
    n_learned_inferences: int  # of policies that load weights
    n_frames: int  # images of two cameras that are rendered for policies and captures; see `n_rendered`
    n_workers: int
    copies: dict[str, int]  # learned policies -> bytes of their weights; each worker loads its own copy
    warnings: tuple[str, ...] = ()  # what a person should know before the first episode
    notes: tuple[str, ...] = ()  # what could not be compared

    def seconds(self, rates: AssumedRates) -> float:
        """Return how long it takes at these rates, all workers busy to the end."""
        simulated = self.n_steps / rates.steps_per_second + self.n_frames / rates.frames_per_second
        return (simulated + self.n_learned_inferences * rates.inference_seconds) / self.n_workers


def describe_evaluation(
    resolved: ResolvedEvaluation, *, rates: AssumedRates, allow_environment_change: bool = False
) -> list[str]:
    """Return lines for a person, or raise what `evaluate` would raise before its first episode."""
    effort = evaluation_effort(resolved, allow_environment_change=allow_environment_change)
    return list(_lines(resolved, effort, rates))


def evaluation_effort(
    resolved: ResolvedEvaluation, *, allow_environment_change: bool = False
) -> EvaluationEffort:
    """Return what is left to run; errors are those of `describe_evaluation`."""
    config, plan = resolved.config, make_plan(resolved)
    records = check_startable(
        resolved.out,
        describe(resolved, plan, command=""),
        allow_environment_change=allow_environment_change,
        groups={job.group.key for job in plan.jobs},
    )
    finished = frozenset(record.key for record in records if record.error is None)
    ahead = [job for job in plan.jobs if job.key not in finished]
    queue = JobQueue(plan.jobs, finished=finished)
    steps = [(job, (job.group.offered.horizon_steps, _donor_steps(job, config))) for job in ahead]
    inferences = [(job, sum(math.ceil(n / _interval(job)) for n in both)) for job, both in steps]
    reads = images_read(resolved.policies)
    rendered = [
        n_rendered(job, config, reads=reads[job.group.part], n_steps=own)
        + _shown(job, config, reads=reads[job.group.part], n_steps=donors)
        for job, (own, donors) in steps
    ]
    learned = [n for job, n in inferences if LEARNED in job.group.args]
    return EvaluationEffort(
        n_episodes=len(plan.jobs),
        n_finished=len(plan.jobs) - len(ahead),
        n_steps=sum(sum(both) for _, both in steps),
        n_inferences=sum(n for _, n in inferences),
        n_learned_inferences=sum(learned),
        n_frames=N_CAMERAS * sum(rendered),
        n_workers=worker_count(resolved, plan, n_jobs=queue.n_batches),
        copies=_bytes_of_weights(plan),
        warnings=tuple(plan.warnings),
        notes=tuple(plan.notes),
    )


def _lines(resolved: ResolvedEvaluation, effort: EvaluationEffort, rates: AssumedRates) -> Iterator[str]:
    config = resolved.config
    yield f"evaluation: {config.name}, to {resolved.out}"
    yield (
        f"tasks {', '.join(config.tasks)}; policies {', '.join(config.policies)}; {config.runs} runs of "
        f"{config.episodes} episodes"
    )
    yield (
        f"episodes: {effort.n_episodes - effort.n_finished:,} to run, {effort.n_finished:,} of "
        f"{effort.n_episodes:,} have a result"
    )
    yield (
        f"at most: {effort.n_steps:,} control steps, {effort.n_inferences:,} inferences, {effort.n_frames:,} "
        f"frames of {N_CAMERAS} cameras"
    )
    yield f"workers: {effort.n_workers}"
    for name, n_bytes in effort.copies.items():
        yield (
            f"  {name}: {n_bytes / GB:.2f} GB of weights × {effort.n_workers} copies, "
            f"{effort.n_workers * n_bytes / GB:.1f} GB"
        )
    for warning in effort.warnings:
        yield f"warning: {warning}"
    for note in effort.notes:
        yield f"note: {note}"
    yield f"time, estimated: {effort.seconds(rates) / 3600:.2g} h"
    yield (
        f"assumptions: {rates.steps_per_second:g} control steps and {rates.frames_per_second:g} frames per "
        f"second and worker, {rates.inference_seconds:g} s per inference of a learned policy, every worker "
        "busy to the end, no episode ends early; starting and loading not counted. The run's progress bar "
        "shows the real rate"
    )


def _bytes_of_weights(plan: Plan) -> dict[str, int]:
    named = {job.group.part: job.group.args.get(LEARNED) for job in plan.jobs}
    paths = {policy: Path(str(path)) for policy, path in named.items() if path is not None}
    files = {policy: weights_file(find_checkpoint(path)) for policy, path in paths.items()}
    return {policy: file.stat().st_size for policy, file in files.items() if file is not None}


Reads = Literal["none", "last", "every"]
"""No image; those of the control step of an inference; those of each control step."""


def images_read(policies: Sequence[PolicyEntry]) -> dict[str, Reads]:
    """Return the images that each policy has to be given, by `EpisodeGroup.part`; all if it is unknown."""
    return {
        policy.part(index): reads
        for policy in policies
        for reads in [_read_by(policy)]
        for index in range(len(policy.recipes))
    }


def n_rendered(job: EpisodeJob, config: EvalConfig, *, reads: Reads, n_steps: int) -> int:
    """Return at how many control steps of an episode of `n_steps` images are rendered at most."""
    for_policy = _shown(job, config, reads=reads, n_steps=n_steps)
    capture = config.capture
    index = job.seed - config.seed_start
    if not any(may_be_wanted(which, run=job.run, index=index) for which in (capture.video, capture.rrd)):
        return for_policy
    return min(n_steps + 1, for_policy + math.ceil((n_steps + 1) / capture.frame_stride))


def _shown(job: EpisodeJob, config: EvalConfig, *, reads: Reads, n_steps: int) -> int:
    """Return at how many control steps images are rendered for the policy."""
    if reads == "every" or (reads == "last" and config.eager_rendering):
        return n_steps
    if reads != "last":
        return 0
    kept = config.cue_view == "first_frame"  # the cue's first frame, which is shown again
    return min(n_steps, math.ceil(n_steps / _interval(job)) + kept)


def _donor_steps(job: EpisodeJob, config: EvalConfig) -> int:
    """Return the control steps of the episode whose memory is put in: none, all, or up to the change."""
    change = config.memory_change
    if change is None or not change.has_donor:
        return 0
    if change.kind == "carry_over":
        return job.group.offered.horizon_steps
    return math.ceil(change.at_step / _interval(job)) * _interval(job)


def _interval(job: EpisodeJob) -> int:
    """Return the control steps between two inferences; where delays vary, at least as many."""
    return job.group.rollout.chunking.interval_steps or job.group.key.n_action_steps


def _read_by(policy: PolicyEntry) -> Reads:
    adapter, args = policy.value.adapter, policy.value.args
    if adapter in SCRIPTED:
        return "none"
    server = policy.server
    if adapter == REMOTE_ADAPTER and server is not None:
        if server.needs_every_frame or args.get("reads") == "every":
            return "every"
        return "none" if args.get("cameras") is None and server.is_ours and not server.cameras else "last"
    checkpoint = args.get("checkpoint")
    if adapter in LEROBOT_CHECKPOINTS and isinstance(checkpoint, str):
        return "every" if _is_shown_every_frame(find_checkpoint(Path(checkpoint))) else "last"
    if adapter in CHECKPOINTS and isinstance(checkpoint, str):
        from vla_eval.policies.agents.network import reads_images  # it imports torch

        return "every" if reads_images(find_checkpoint(Path(checkpoint))) else "none"
    return "every"


def _is_shown_every_frame(folder: Path) -> bool:
    # Here and not above: a dry run of scripted policies need not wait for torch.
    from vla_eval.checkpoints.loading import LoadOptions, make_unfilled_policy, read_config
    from vla_eval.checkpoints.policy_types import history
    from vla_eval.models.episodes.memory import remembers

    config = read_config(folder, LoadOptions(device="cpu"))
    return len(history(config)) > 1 or remembers(make_unfilled_policy(config))
