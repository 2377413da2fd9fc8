"""The fake simulator with stored frames in the place of its own, and the actions that it executed."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.core import EpisodeStart, FloatArray, StepResult
from vla_eval.envs.factory import make_env
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import LeRobotPolicy
from vla_eval.rollout import RolloutSettings, rollout

TASK = "RememberColor3-v0"


class StoredFrames:
    """Shows frame n (H, W, 3) of each camera after n steps; the last one from then on."""

    def __init__(self, frames: Mapping[str, NDArray[np.uint8]]) -> None:
        self._env: Any = make_env(EnvSettings(task=TASK, simulator="fake", cameras=tuple(frames)))
        self._frames = frames
        edges = {name: stored.shape[1] for name, stored in frames.items()}
        cameras = [camera for camera in self._env.spec.cameras if camera.name in frames]
        self.spec = replace(
            self._env.spec,
            cameras=tuple(replace(c, height_px=edges[c.name], width_px=edges[c.name]) for c in cameras),
        )
        self.asked: list[FloatArray] = []
        self.executed: list[FloatArray] = []

    def reset(self, seeds: Mapping[int, int], *, render: bool) -> dict[int, StepResult]:
        return {slot: self._shown(x) for slot, x in self._env.reset(seeds, render=render).items()}

    def step(self, actions: Mapping[int, FloatArray], *, render: frozenset[int]) -> dict[int, StepResult]:
        results = self._env.step(actions, render=render)
        self.asked += actions.values()
        self.executed += [result.executed_action for result in results.values()]
        return {slot: self._shown(result) for slot, result in results.items()}

    def hold_action(self, slot: int) -> FloatArray:
        action: FloatArray = self._env.hold_action(slot)
        return action

    def close(self) -> None:
        self._env.close()

    def _shown(self, result: StepResult) -> StepResult:
        seen = result.observation
        images = {
            name: self._frames[name][min(seen.step, len(self._frames[name]) - 1)] for name in seen.images
        }
        return replace(result, observation=replace(seen, images=images))


def context(env: StoredFrames, n_action_steps: int) -> PolicyContext:
    chunking = ChunkingSpec(n_action_steps=n_action_steps)
    return PolicyContext(name="golden", env=env.spec, chunking=chunking, n_candidates=3, n_slots=1)


def executed(
    env: StoredFrames, policy: LeRobotPolicy, instruction: str, *, n_action_steps: int, n_steps: int
) -> FloatArray:
    """Return (n_steps, A): what an episode of `mikasa-vla eval` executes in the environment."""
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction=instruction, horizon_steps=n_steps)
    settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=n_action_steps))
    first = len(env.executed)
    rollout(env, policy, [start], settings)
    return np.stack(env.executed[first:])
