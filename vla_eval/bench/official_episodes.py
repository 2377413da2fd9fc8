"""Run episodes with the official package's own runner, in its environment; the last line is JSON."""

import argparse
import json
import sys
import time
from typing import Any  # mikasa_robo_suite and gymnasium are untyped

import numpy as np

N_ACTIONS = 7
CHUNK_SIZE = 8  # the official runner renders each step, whatever the policy reads


class RandomChunks:
    """Reads the last observation, and returns a chunk of random actions."""

    chunk_size = CHUNK_SIZE

    def __init__(self) -> None:
        self._draws = np.random.default_rng(0)

    def forward(self, obs: Any) -> Any:
        """Return (K, 7) float32."""
        return self._draws.uniform(-1, 1, (CHUNK_SIZE, N_ACTIONS)).astype("float32")


def make_env(task: str, horizon_steps: int) -> Any:
    """Make the environment as the official runner does, with another length of an episode."""
    import gymnasium
    from mikasa_robo_suite.vla.benchmarking import BenchmarkConfig
    from mikasa_robo_suite.vla.utils.apply_wrappers import apply_mikasa_vla_wrappers

    config = BenchmarkConfig(sim_backend="cpu")
    env = gymnasium.make(
        task,
        num_envs=1,
        obs_mode=config.obs_mode,
        control_mode=config.control_mode,
        render_mode="all",
        reward_mode=config.reward_mode,
        sim_backend=config.sim_backend,
        max_episode_steps=horizon_steps,
    )
    return apply_mikasa_vla_wrappers(env, include_overlays=False)


def main() -> int:
    """Run the episodes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("task")
    parser.add_argument("horizon_steps", type=int)
    parser.add_argument("episodes", type=int)
    args = parser.parse_args()
    begun = time.perf_counter()
    from mikasa_robo_suite.vla.benchmarking import run_episode

    env, policy = make_env(args.task, args.horizon_steps), RandomChunks()
    n_steps, seconds, cpu_seconds = [], [], []
    for episode in range(args.episodes):
        result, _ = run_episode(env, policy, 1 + episode)
        n_steps.append(result.n_steps)
        seconds.append(time.perf_counter() - begun)
        cpu_seconds.append(time.process_time())
    env.close()
    print(json.dumps({"n_steps": n_steps, "seconds": seconds, "cpu_seconds": cpu_seconds}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
