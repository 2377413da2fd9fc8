"""What tests ask of a configuration: each resolves it, as the command line does, then asks the real one."""

from pathlib import Path
from typing import Any

from vla_eval.config.evaluation import EvalConfig
from vla_eval.evaluation import dry_run, plan
from vla_eval.evaluation import evaluate as evaluating
from vla_eval.evaluation.dry_run import EvaluationEffort
from vla_eval.evaluation.evaluate import EvaluationSummary
from vla_eval.evaluation.resolve import resolve
from vla_eval.storage.shard import Shard
from vla_eval.workers.backend import Backend
from vla_eval.workers.local import LOCAL


def evaluate(
    config: EvalConfig,
    *,
    out: Path | None = None,
    shard: Shard | None = None,
    backend: Backend = LOCAL,
    **options: Any,
) -> EvaluationSummary:
    return evaluating.evaluate(resolve(config, out=out, shard=shard, backend=backend), **options)


def evaluation_effort(
    config: EvalConfig, *, out: Path | None = None, shard: Shard | None = None, **options: Any
) -> EvaluationEffort:
    return dry_run.evaluation_effort(resolve(config, out=out, shard=shard), **options)


def make_plan(config: EvalConfig) -> plan.Plan:
    return plan.make_plan(resolve(config))


def plan_shard(config: EvalConfig, shard: Shard | None) -> plan.Plan:
    return plan.make_plan(resolve(config, shard=shard))


def fingerprint(config: EvalConfig) -> str:
    return resolve(config).fingerprint


def results_config(config: EvalConfig) -> dict[str, Any]:
    return resolve(config).results_config


def default_run_folder(config: EvalConfig) -> Path:
    return resolve(config).default_folder
