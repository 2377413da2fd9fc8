"""The parts of a run: episodes whose policy is in the workers, then one shared policy after another."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vla_eval.checkpoints.notes import COMPILE
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import digest_of
from vla_eval.errors import RemoteConnectionError, RemoteReplyError, RemoteTimeoutError, RunChangedError
from vla_eval.evaluation.episode_jobs import EpisodeJob
from vla_eval.evaluation.plan import Plan
from vla_eval.evaluation.resolve import ResolvedEvaluation
from vla_eval.policies.registry import own_modules
from vla_eval.policies.remote.settings import ADAPTER as REMOTE_ADAPTER
from vla_eval.records import EpisodeError

if TYPE_CHECKING:
    from vla_eval.serving.shared import SharedServers

CONNECTION_ERRORS = frozenset(
    error.__name__ for error in (RemoteConnectionError, RemoteReplyError, RemoteTimeoutError)
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Phase:
    """Episodes run before the next ones begin, of the shared `policy`; None: of policies in the workers."""

    jobs: tuple[EpisodeJob, ...]
    policy: str | None


def phases(plan: Plan) -> Iterator[Phase]:
    """Return the parts of a run that have episodes, in order."""
    in_workers = tuple(job for job in plan.jobs if job.group.part not in plan.shared)
    if in_workers:
        yield Phase(jobs=in_workers, policy=None)
    for policy in plan.shared:
        jobs = tuple(job for job in plan.jobs if job.group.part == policy)
        if jobs:
            yield Phase(jobs=jobs, policy=policy)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadyPhase:
    """A phase as workers get it, and the servers that its episodes need; None: it needs none."""

    jobs: Sequence[EpisodeJob]
    servers: "SharedServers | None"

    def lost_its_server(self, error: EpisodeError) -> bool:
        """Whether an episode's error comes of a server that is there no longer."""
        return self.servers is not None and error.kind in CONNECTION_ERRORS and self.servers.one_has_ended()


@contextlib.contextmanager
def with_servers(
    phase: Phase, resolved: ResolvedEvaluation, plan: Plan, *, logs: Path, stops: Callable[[], bool]
) -> Iterator[ReadyPhase | None]:
    """Give a phase as workers get it, with its servers; None if `stops` says so meanwhile."""
    if phase.policy is None:
        yield ReadyPhase(jobs=phase.jobs, servers=None)
        return
    # Here and not above: most evaluations share no policy, and servers take long to import.
    from vla_eval.serving.host import HostOptions
    from vla_eval.serving.shared import SharedServers

    config = resolved.config
    options = HostOptions(
        policy=plan.shared[phase.policy],
        max_batch=config.inference_max_batch,
        compile=bool(phase.jobs[0].group.args.get(COMPILE)),
        chunking=config.chunking,
    )
    adapters = [job.group.adapter for job in phase.jobs[:1]]
    with SharedServers(
        options,
        logs=logs,
        start_seconds=config.timeouts.setup_seconds,
        preload=own_modules(adapters),
        backend=resolved.backend,
        stops=stops,
    ) as servers:
        if servers.was_stopped:
            yield None
            return
        _check_same(phase.policy, plan, servers)
        yield ReadyPhase(jobs=[_remote(job, servers, config) for job in phase.jobs], servers=servers)


def _check_same(policy: str, plan: Plan, servers: "SharedServers") -> None:
    planned, found = plan.recipe_hashes[f"policies/{policy}"], servers.metadata.recipe_sha256
    if planned != found:
        raise RunChangedError(
            f"policy '{policy}': its recipe or checkpoint changed while the run was starting (expected the "
            f"digest {planned:.12}…, found {found or 'none':.12}…). Start the run again."
        )


def _remote(job: EpisodeJob, servers: "SharedServers", config: EvalConfig) -> EpisodeJob:
    from vla_eval.serving.shared import KEY_VARIABLE

    n_rows = servers.metadata.batch_max or 1
    args = {
        "url": servers.urls,
        "identity_sha256": digest_of(servers.metadata.identity()),
        "api_key_env": KEY_VARIABLE,
        "timeout_seconds": config.timeouts.inference_seconds,
        "connect_seconds": 0.0,
    }
    group = replace(job.group, adapter=REMOTE_ADAPTER, args=args, n_rows=n_rows)
    return replace(job, group=group, row=job.row % n_rows)
