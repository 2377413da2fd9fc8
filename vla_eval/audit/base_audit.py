"""Which tasks of MIKASA-Base need memory? By how far a player without it gets from random to the oracle.

No audit proves that a task needs memory: the memoryless player is the best that is known, no more.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vla_eval.audit.evaluations import refuse_own_fields
from vla_eval.base_tasks.catalog import base_task
from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import check_names
from vla_eval.results.estimates import CONFIDENCE, Interval, mean_return
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.catalog import task_spec

CONTROLS = ("random", "memoryless", "oracle")
ENOUGH = 0.9
"""Where a player without memory gets this far from random to the oracle, memory is mostly not needed."""
N_RESAMPLES, RESAMPLING_SEED = 2000, 0

NEEDS, MOSTLY_NOT, UNDECIDED = "needs memory", "mostly not", "undecided: more episodes"
NOT_KNOWN = "not known: no good player without memory is known"
NOT_OBSERVED = "cannot be solved as observed by a policy that draws its actions: it is not shown them"


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlReturn:
    """A control's mean return, and its 95 % interval."""

    n_episodes: int
    mean: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseAudit:
    """The audit of one task."""

    task: str
    version: int
    returns: Mapping[str, ControlReturn]  # by the names of the controls
    # how far the memoryless player gets from random to the oracle, and the 95 % interval; None where one of
    # them has no episode
    share: float | None
    share_low: float | None
    share_high: float | None
    verdict: tuple[str, ...]
    n_errors: int = 0


def base_audit_config(
    tasks: Sequence[str],
    *,
    episodes: int,
    workers: int | Literal["auto"],
    controls: Sequence[str] | None = None,
    settings: Mapping[str, Any] | None = None,  # Any: other fields of `EvalConfig`
) -> EvalConfig:
    """Return the evaluation that an audit consists of, of these controls only, if given."""
    check_names("control", controls or (), CONTROLS, where="--control")
    fields = dict(settings or {})
    refuse_own_fields(fields)
    return EvalConfig(
        name="audit_mikasa_base",
        tasks=tuple(tasks),
        policies=tuple(name for name in CONTROLS if controls is None or name in controls),
        episodes=episodes,
        workers=workers,
        **fields,
    )


def read_base_audit(config: EvalConfig, out: Path) -> tuple[BaseAudit, ...]:
    """Return the audit of each task from the run folder of a configuration."""
    found: dict[str, dict[str, dict[int, float]]] = {}
    n_errors: dict[str, int] = {}
    for record in read_run(out / config.name).records:
        if record.episode_return is None:
            n_errors[record.task] = n_errors.get(record.task, 0) + 1
        else:
            of_task = found.setdefault(record.task, {})
            of_task.setdefault(record.policy, {})[record.seed] = record.episode_return
    ids = [task_spec(task).id for task in config.tasks]
    return tuple(audit_base_task(task, found.get(task, {}), n_errors=n_errors.get(task, 0)) for task in ids)


def audit_base_task(task: str, returns: Mapping[str, Mapping[int, float]], *, n_errors: int = 0) -> BaseAudit:
    """Return the audit of a task.

    Args:
        task: its id.
        returns: control -> seed -> return.
        n_errors: episodes without a result.
    """
    row = base_task(task)
    share = _share(returns)
    return BaseAudit(
        task=task,
        version=row.version,
        returns={name: _mean(returns[name]) for name in CONTROLS if returns.get(name)},
        share=share[0] if share else None,
        share_low=share[1].low if share else None,
        share_high=share[1].high if share else None,
        verdict=_verdict(share, has_player=row.memoryless is not None, hides_action=row.hides_action),
        n_errors=n_errors,
    )


def _mean(by_seed: Mapping[int, float]) -> ControlReturn:
    mean, interval = mean_return([list(by_seed.values())])
    return ControlReturn(n_episodes=len(by_seed), mean=mean, low=interval.low, high=interval.high)


def _share(returns: Mapping[str, Mapping[int, float]]) -> tuple[float, Interval] | None:
    """Return (R_memoryless - R_random) / (R_oracle - R_random) on the same seeds, and its 95 % interval.

    None with less than two seeds, or where the oracle is no better than random: there is no way to go then.

    Source of the interval: the percentile bootstrap over seeds (Efron 1979); resamples in which the oracle is
    no better than random are left out.
    """
    seeds = sorted(set.intersection(*(set(returns.get(name, {})) for name in CONTROLS)))
    if len(seeds) < 2:
        return None
    found = np.array([[returns[name][seed] for seed in seeds] for name in CONTROLS])
    rng = np.random.default_rng(RESAMPLING_SEED)
    drawn = rng.integers(len(seeds), size=(N_RESAMPLES, len(seeds)))
    means = np.concatenate([found.mean(axis=1, keepdims=True), found[:, drawn].mean(axis=2)], axis=1)
    floor, without, best = means[:, means[2] > means[0]]
    if means[2, 0] <= means[0, 0]:
        return None
    shares = (without - floor) / (best - floor)
    low, high = np.quantile(shares[1:], [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(shares[0]), Interval(float(low), float(high))


def _verdict(
    share: tuple[float, Interval] | None, *, has_player: bool, hides_action: bool
) -> tuple[str, ...]:
    also = (NOT_OBSERVED,) if hides_action else ()
    if not has_player:
        return (NOT_KNOWN, *also)
    if share is None:
        return (UNDECIDED, *also)
    _, interval = share
    if interval.high < ENOUGH:
        return (NEEDS, *also)
    return (MOSTLY_NOT if interval.low >= ENOUGH else UNDECIDED, *also)


def render_base_audit(audits: Sequence[BaseAudit], style: str) -> str:
    """Return the audit as `json` or as `markdown`."""
    if style == "json":
        return json.dumps([asdict(audit) for audit in audits], indent=2)
    header = ["task", *CONTROLS, "share without memory", "verdict"]
    rows = [header, [":--", *["--:"] * (1 + len(CONTROLS)), ":--"], *map(_row, audits)]
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    n_errors = sum(audit.n_errors for audit in audits)
    notes = [
        "Mean return with its 95 % t interval. share without memory: (memoryless - random) / (oracle - "
        "random) on the same seeds, with its bootstrap interval."
        f" `{MOSTLY_NOT}`: at least {ENOUGH:g}; `{NEEDS}`: less. "
        "docs/base_audit.md explains players and verdicts."
    ]
    if n_errors:
        notes.append(
            f"{n_errors} episodes ended in an error and are in no cell; the same command retries them."
        )
    return "\n".join([*lines, "", *notes])


def _row(audit: BaseAudit) -> list[str]:
    cells = []
    for name in CONTROLS:
        one = audit.returns.get(name)
        cells.append("—" if one is None else f"{one.mean:.3g} [{one.low:.3g}, {one.high:.3g}]")
    share = (
        "—" if audit.share is None else f"{audit.share:.2f} [{audit.share_low:.2f}, {audit.share_high:.2f}]"
    )
    return [audit.task.partition("/")[2], *cells, share, "; ".join(audit.verdict)]
