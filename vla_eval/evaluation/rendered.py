"""How many images an evaluation renders at most, as far as that is known before any policy is made."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.checkpoints.notes import LEROBOT_CHECKPOINTS
from vla_eval.config.capture import may_be_wanted
from vla_eval.config.evaluation import EvalConfig
from vla_eval.evaluation.episode_jobs import EpisodeJob
from vla_eval.policies.entries import PolicyEntry
from vla_eval.policies.registry import SCRIPTED
from vla_eval.policies.remote.settings import ADAPTER as REMOTE_ADAPTER

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
    for_policy = 0
    if reads == "every" or (reads == "last" and config.eager_rendering):
        for_policy = n_steps
    elif reads == "last":
        kept = config.cue_view == "first_frame"  # the cue's first frame, which is shown again
        for_policy = min(n_steps, math.ceil(n_steps / job.group.key.n_action_steps) + kept)
    capture = config.capture
    index = job.seed - config.seed_start
    if not any(may_be_wanted(which, run=job.run, index=index) for which in (capture.video, capture.rrd)):
        return for_policy
    return min(n_steps + 1, for_policy + math.ceil((n_steps + 1) / capture.frame_stride))


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
    return "every"


def _is_shown_every_frame(folder: Path) -> bool:
    # Here and not above: a dry run of scripted policies need not wait for torch.
    from vla_eval.checkpoints.loading import LoadOptions, make_unfilled_policy, read_config
    from vla_eval.checkpoints.policy_types import history
    from vla_eval.models.episodes.memory import remembers

    config = read_config(folder, LoadOptions(device="cpu"))
    return len(history(config)) > 1 or remembers(make_unfilled_policy(config))
