"""Steps per second of each task of MIKASA-Base; where it runs in another package, beside that package's own.

    python scripts/base_speed.py [NAME ...]

One core; both sides as `gymnasium.make` gives them, with random actions drawn before the clock starts, in one
run, interleaved; the best of three.
"""

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np

import vla_eval.base_tasks.register  # noqa: F401
from vla_eval.base_tasks.catalog import BASE_TASKS
from vla_eval.base_tasks.row import BaseTask
from vla_eval.errors import MissingDependencyError

N_STEPS, N_ROUNDS, MAX_SECONDS = 5000, 3, 2.0


def main(names: Sequence[str]) -> None:
    """Print a row per task."""
    print(f"{'task':38}{'steps/s':>10}{'upstream':>10}{'ratio':>8}")
    for name in names or BASE_TASKS:
        try:
            ours = gymnasium.make(BASE_TASKS[name].gym_id)
        except MissingDependencyError as exc:
            print(f"{name:38}{exc}")
            continue
        theirs = _upstream(BASE_TASKS[name])
        rng = np.random.default_rng(0)
        ours.action_space.seed(int(rng.integers(2**31)))
        actions = [ours.action_space.sample() for _ in range(N_STEPS)]
        rates = [[_steps_per_second(env, actions) for env in (ours, theirs) if env] for _ in range(N_ROUNDS)]
        best = np.max(rates, axis=0)
        beside = f"{best[1]:10,.0f}{best[0] / best[1]:8.2f}" if len(best) > 1 else f"{'—':>10}{'—':>8}"
        print(f"{name:38}{best[0]:10,.0f}{beside}", flush=True)
        ours.close()


def _steps_per_second(env: Any, actions: Sequence[Any]) -> float:
    env.reset(seed=0)
    began, n_steps = time.perf_counter(), 0
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        n_steps += 1
        if terminated or truncated:
            env.reset()
        if n_steps % 100 == 0 and time.perf_counter() - began > MAX_SECONDS:
            break
    return n_steps / (time.perf_counter() - began)


def _upstream(row: BaseTask) -> Any:
    """Return the package's own environment, for the families that run in one."""
    made: dict[str, Callable[[], Any]] = {
        "vla_eval.base_tasks.popgym_env": lambda: _popgym(row),
        "vla_eval.base_tasks.minigrid_memory": lambda: _minigrid(row),
    }
    make = made.get(row.entry_point.partition(":")[0])
    return make() if make else None


def _popgym(row: BaseTask) -> Any:
    from vla_eval.base_tasks.popgym_env import GAMES, popgym_class

    arguments = dict(row.kwargs)
    game = GAMES[arguments.pop("game")]
    return _as_made(lambda: popgym_class(game)(**arguments))


def _minigrid(row: BaseTask) -> Any:
    from minigrid.envs.memory import MemoryEnv

    return _as_made(lambda: MemoryEnv(max_steps=row.horizon_steps, **row.kwargs))


def _as_made(make: Callable[[], Any]) -> Any:
    """Return an environment with the wrappers that every made one has."""
    return gymnasium.make(gymnasium.envs.registration.EnvSpec("upstream-v0", entry_point=make))


if __name__ == "__main__":
    main(sys.argv[1:])
