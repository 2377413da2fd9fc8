"""Does a task of the catalogue behave as its row says?"""

from collections.abc import Mapping
from typing import Any

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings, Simulator
from vla_eval.config.prompts import instruction_for
from vla_eval.core import EpisodeStart, SimEnv
from vla_eval.envs.factory import make_env
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls import scripted
from vla_eval.records import EpisodeRecord
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.task_state import PHASES
from vla_eval.tasks.catalog import task_spec
from vla_eval.testing.check_env import check_env
from vla_eval.testing.claims import claim

MIN_ORACLE_SUCCESS = 0.9


def check_task(
    task: str,
    *,
    kwargs: Mapping[str, Any] | None = None,  # Any: whatever the task's arguments are
    n_episodes: int = 10,
    simulator: Simulator = "maniskill",
) -> None:
    """Raise `ConformanceError` unless the task behaves as its row says; nothing is rendered.

    The environment fulfils its contract (`check_env`). Doing nothing never succeeds, unless the row says so.
    The oracle succeeds in at least nine of ten episodes and touches the right candidate first. The phases
    come in order. `simulator` is `maniskill` or `fake`.
    """
    settings = EnvSettings(task=task, kwargs=kwargs or {}, privileged=True, simulator=simulator)
    check_env(lambda: make_env(settings), renders=False)
    env = make_env(settings)
    try:
        _check_phases(env)
        n_candidates = task_spec(task).n_candidates(settings.kwargs)
        idle = _play(env, task, "hold", n_episodes, n_candidates=n_candidates)
        idle_wins = any(record.success_once for record in idle)
        may_idle = task_spec(task).idle_success > 0
        claim(may_idle or not idle_wins, f"{task}: doing nothing never succeeds.")
        expert = _play(env, task, "oracle", n_episodes, n_candidates=n_candidates)
        rate = sum(bool(record.success_once) for record in expert) / n_episodes
        claim(rate >= MIN_ORACLE_SUCCESS, f"{task}: the oracle succeeds.", f"{rate:.2f} of {n_episodes}")
        right = all(record.first_choice_success is not False for record in expert if record.success_once)
        claim(right, f"{task}: the oracle touches the right candidate first.")
    finally:
        env.close()


def _check_phases(env: SimEnv) -> None:
    result = env.reset({0: 1}, render=False)[0]
    seen = [result.status.phase]
    for _ in range(env.spec.horizon_steps):
        result = env.step({0: env.hold_action(0)}, render=frozenset())[0]
        seen.append(result.status.phase)
    ranks = [PHASES.index(phase) for phase in seen if phase is not None]
    claim(ranks == sorted(ranks), f"{env.spec.task}: phases come in the order {', '.join(PHASES)}.")
    claim(seen[-1] == "response", f"{env.spec.task}: the response phase begins before the horizon.")


def _play(env: SimEnv, task: str, policy: str, n_episodes: int, *, n_candidates: int) -> list[EpisodeRecord]:
    chunking = ChunkingSpec(n_action_steps=1)
    context = PolicyContext(name=policy, env=env.spec, chunking=chunking, n_candidates=n_candidates)
    made = scripted.make_hold(context) if policy == "hold" else scripted.make_oracle(context)
    records = []
    for seed in range(1, n_episodes + 1):
        start = EpisodeStart(
            slot=0,
            task=task,
            seed=seed,
            run=0,
            instruction=instruction_for(task_spec(task)),
            horizon_steps=env.spec.horizon_steps,
        )
        records += rollout(env, made, [start], RolloutSettings(chunking=chunking))
    return records
