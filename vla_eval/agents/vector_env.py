"""The slots of one environment as the library's `VecEnv`: each begins its next episode by itself.

The episode k that slot i has begun since the last checkpoint is a function of run seed, checkpoint, i and k.
"""

from collections.abc import Mapping, Sequence
from typing import Any  # the library's infos and indices

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from vla_eval.agents.expert import Expert
from vla_eval.config.agents import TRAINING_SEEDS, Rewards
from vla_eval.core import SimEnv, StepResult
from vla_eval.policies.agents.observing import Reader, Seen, action_space, as_action, space_of
from vla_eval.seeding import Stream, generator


class EpisodeTotals:
    """What an episode of the training adds up to."""

    def __init__(self) -> None:
        self.episode_return, self.success, self.n_steps = 0.0, False, 0

    def note(self, result: StepResult, reward: float) -> None:
        """Account for one step."""
        self.episode_return += reward
        self.success |= result.status.success
        self.n_steps += 1


def reward_of(result: StepResult, kind: Rewards) -> float:
    """Return a step's reward: the task's own, or 1 while its success rule holds (ManiSkill's `sparse`)."""
    return result.reward if kind == "dense" else float(result.status.success)


class SlotsEnv(VecEnv):
    """The slots of an environment; an episode that its rules do not end is *truncated* at the horizon.

    `expert`: who acts in it for an algorithm that imitates; None for others.
    """

    def __init__(
        self,
        env: SimEnv,
        reader: Reader,
        *,
        n_slots: int,
        reward: Rewards,
        run_seed: int,
        expert: Expert | None = None,
    ) -> None:
        self._env, self._reader, self._reward, self._run_seed = env, reader, reward, run_seed
        self.expert = expert
        self._segment = 0
        self._n_begun = [0] * n_slots
        self._episodes = [EpisodeTotals() for _ in range(n_slots)]
        self._actions: np.ndarray[Any, Any] = np.zeros(0)
        self.finished: list[EpisodeTotals] = []
        self._slots = tuple(range(n_slots))
        example = self._begin(self._slots)[0]
        super().__init__(n_slots, space_of(example), action_space(env.spec.action))

    def begin_segment(self, first_step: int) -> None:
        """Let the episodes from now on be those that follow the checkpoint of this step."""
        self._segment = first_step
        self._n_begun = [0] * len(self._slots)

    def reset(self) -> Any:
        """Begin an episode in each slot."""
        seen = self._begin(self._slots)
        return _stacked([seen[slot] for slot in self._slots])

    def step_async(self, actions: np.ndarray[Any, Any]) -> None:
        """Take the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Execute them, and return observations, rewards, ends and infos."""
        spec = self._env.spec
        render = frozenset(self._slots if self._reader.cameras else ())
        actions = {slot: as_action(spec.action, self._actions[slot]) for slot in self._slots}
        results = self._env.step(actions, render=render)
        seen = {slot: self._reader.read(results[slot].observation) for slot in self._slots}
        rewards = np.array([reward_of(results[slot], self._reward) for slot in self._slots], np.float32)
        infos: list[dict[str, Any]] = [{} for _ in self._slots]
        over: list[int] = []
        for slot in self._slots:
            status = results[slot].status
            self._episodes[slot].note(results[slot], float(rewards[slot]))
            by_rules = status.is_over or status.fail
            if by_rules or results[slot].observation.step >= spec.horizon_steps:
                over.append(slot)
                infos[slot] = {"terminal_observation": seen[slot], "TimeLimit.truncated": not by_rules}
                self.finished.append(self._episodes[slot])
        if over:
            seen |= self._begin(over)
        dones = np.isin(self._slots, over)
        return _stacked([seen[slot] for slot in self._slots]), rewards, dones, infos

    def close(self) -> None:
        """Release the simulator."""
        self._env.close()

    def _begin(self, slots: Sequence[int]) -> dict[int, Seen]:
        seeds = {slot: self._next_seed(slot) for slot in slots}
        results = self._env.reset(seeds, render=bool(self._reader.cameras))
        for slot in slots:
            self._episodes[slot] = EpisodeTotals()
        return {slot: self._reader.read(results[slot].observation) for slot in slots}

    def _next_seed(self, slot: int) -> int:
        drawn = generator(self._run_seed, Stream.AGENT, self._segment, slot, self._n_begun[slot])
        self._n_begun[slot] += 1
        return int(drawn.integers(TRAINING_SEEDS.start, TRAINING_SEEDS.stop))

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute, the same for each slot."""
        return [getattr(self, attr_name, None) for _ in self._indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: nothing of an environment is changed from outside."""
        raise NotImplementedError(f"{attr_name} cannot be set")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Refuse: nothing of an environment is called from outside."""
        raise NotImplementedError(f"{method_name} cannot be called")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Say no."""
        return [False for _ in self._indices(indices)]

    def _indices(self, indices: Any) -> Sequence[int]:
        return self._slots if indices is None else list(self._get_indices(indices))


def _stacked(seen: Sequence[Seen]) -> Mapping[str, np.ndarray[Any, Any]]:
    return {name: np.stack([one[name] for one in seen]) for name in seen[0]}
