"""Take one shard of a plan. Slots, rows and run numbers stay those of the whole plan, and so do records."""

from collections.abc import Sequence
from dataclasses import replace

from vla_eval.config.evaluation import EvalConfig
from vla_eval.evaluation.plan import Plan, make_plan
from vla_eval.policies.entries import PolicyEntry
from vla_eval.storage.shard import Shard


def plan_shard(
    config: EvalConfig, shard: Shard | None, policies: Sequence[PolicyEntry] | None = None
) -> Plan:
    """Plan the episodes of a configuration, and keep those of one shard; None: all.

    `policies`: see `make_plan`.

    Raises:
        RecipeError: there are more shards than blocks of episodes that stay together.
        VlaEvalError: see `make_plan`.
    """
    plan = make_plan(config, policies)
    if shard is None:
        return plan
    groups = tuple(dict.fromkeys(job.group.key for job in plan.jobs))
    # Episodes that run side by side stay together, so that a batch has the same neighbours as in one run.
    own = replace(shard.of_blocks(config.slots_per_worker, config.episodes), groups=groups)
    jobs = tuple(job for job in plan.jobs if own.holds(job.seed - config.seed_start))
    return replace(plan, jobs=jobs, shard=own)
