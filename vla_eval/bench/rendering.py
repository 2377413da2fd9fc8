"""Measure eager against lazy rendering: the same episode and actions, in turn in one process."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings, RenderSettings
from vla_eval.core import EpisodeStart, SimEnv
from vla_eval.envs.factory import describe_device, make_env
from vla_eval.errors import ConformanceError
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.testing.looking_policy import CAMERAS, LookingPolicy


class Cost(NamedTuple):
    """Seconds of an episode, wall clock and CPU, and the digest of its record."""

    wall_seconds: float
    cpu_seconds: float
    digest: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchRow:
    """Eager against lazy rendering at one chunk length; milliseconds are per control step."""

    n_action_steps: int
    n_steps: int
    eager_ms: float
    lazy_ms: float
    eager_cpu_ms: float
    lazy_cpu_ms: float

    @property
    def speed_up(self) -> float:
        """Eager wall-clock time over lazy."""
        return self.eager_ms / self.lazy_ms

    @property
    def cpu_speed_up(self) -> float:
        """Eager CPU time over lazy."""
        return self.eager_cpu_ms / self.lazy_cpu_ms


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchReport:
    """What one run measured."""

    task: str
    device: str
    wrist_mesh: str
    physics_ms: float
    rows: tuple[BenchRow, ...]


def run_bench(
    task: str, *, chunk_lengths: Sequence[int], repeats: int, wrist_mesh: RenderSettings
) -> BenchReport:
    """Measure; the lowest of `repeats` times counts. `ConformanceError`: lazy and eager episodes differ."""
    env = make_env(EnvSettings(task=task, cameras=CAMERAS, render=wrist_mesh))
    blind = make_env(EnvSettings(task=task))
    try:
        _episode(env, 1, CAMERAS, eager=True)  # starts the renderer and compiles its shaders
        _episode(blind, 1, (), eager=False)
        rows = tuple(_row(env, k, repeats) for k in chunk_lengths)
        physics = min(_episode(blind, 1, (), eager=False).wall_seconds for _ in range(repeats))
        device = describe_device(env)
        return BenchReport(
            task=task,
            device=device.get("render_device", "unknown"),
            wrist_mesh=wrist_mesh.wrist_mesh,
            physics_ms=1000 * physics / env.spec.horizon_steps,
            rows=rows,
        )
    finally:
        env.close()
        blind.close()


def _row(env: SimEnv, n_action_steps: int, repeats: int) -> BenchRow:
    eager, lazy = [], []
    for _ in range(repeats):
        eager.append(_episode(env, n_action_steps, CAMERAS, eager=True))
        lazy.append(_episode(env, n_action_steps, CAMERAS, eager=False))
    if len({cost.digest for cost in (*eager, *lazy)}) != 1:
        raise ConformanceError(
            f"{env.spec.task}, n_action_steps={n_action_steps}: lazy and eager rendering gave different "
            "episodes, expected bit-equal ones. Please report this with the output of `mikasa-vla doctor`."
        )
    per_step = 1000 / env.spec.horizon_steps
    return BenchRow(
        n_action_steps=n_action_steps,
        n_steps=env.spec.horizon_steps,
        eager_ms=per_step * min(cost.wall_seconds for cost in eager),
        lazy_ms=per_step * min(cost.wall_seconds for cost in lazy),
        eager_cpu_ms=per_step * min(cost.cpu_seconds for cost in eager),
        lazy_cpu_ms=per_step * min(cost.cpu_seconds for cost in lazy),
    )


def _episode(env: SimEnv, n_action_steps: int, cameras: tuple[str, ...], *, eager: bool) -> Cost:
    chunking = ChunkingSpec(n_action_steps=n_action_steps)
    start = EpisodeStart(
        slot=0,
        task=env.spec.task,
        seed=1,
        run=0,
        instruction="look and move",
        horizon_steps=env.spec.horizon_steps,
    )
    settings = RolloutSettings(chunking=chunking, eager_rendering=eager)
    wall, cpu = time.perf_counter(), time.process_time()
    (record,) = rollout(env, LookingPolicy(n_action_steps, cameras), [start], settings)
    return Cost(time.perf_counter() - wall, time.process_time() - cpu, record.trajectory_sha256)
