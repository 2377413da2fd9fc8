"""What those read who step ManiSkill's environment itself: info, observation and reward as tensors.

The harness reads arrays, see `MemoryTableEnv.read_info`, and makes none of these.
"""

from collections.abc import Mapping
from typing import Any  # ManiSkill is untyped

import numpy as np
import torch
from numpy.typing import NDArray

from vla_eval.core import FloatArray
from vla_eval.tasks.arm.arm_control import ArmControl

Array = NDArray[Any]  # (B, …) numbers or flags
Info = dict[str, Array]
"""Name -> (B, …)."""


class TensorsOut(ArmControl):
    """Turns what a task says in arrays into what ManiSkill's own `step` and `reset` return."""

    MAX_REWARD: float
    PROMPT_DIMS: tuple[str, ...] = ()
    """Names of the numbers that specify the goal, if a sentence cannot; rad."""
    instruction: str | None

    def extra_info(self) -> Info:
        """Return what only those read who step ManiSkill's environment itself, (B, …) arrays by name."""
        return {}

    def oracle_info(self) -> Array:
        """Return what only an oracle may know, (B, …)."""
        raise NotImplementedError

    def prompt(self) -> FloatArray:
        """Return the (B, D) numbers that come with each observation, as `PROMPT_DIMS` names them."""
        raise NotImplementedError

    def _privileged_extra(self) -> Info:
        """Return the task's entries of the state observation; never part of a visual observation."""
        raise NotImplementedError

    def reward_terms(self, info: Info) -> Info:
        """Return the (B,) summands of the dense reward where the episode is not solved."""
        raise NotImplementedError

    def dense_reward(self, terms: Info, info: Info) -> FloatArray:
        """Return the (B,) sum of the terms, or `MAX_REWARD` where the success rule holds."""
        total: FloatArray = np.zeros(self.num_envs, dtype=np.float32)
        for term in terms.values():
            total += term.astype(np.float32, copy=False)
        total[info["success"]] = self.MAX_REWARD
        return total

    def get_info(self) -> dict[str, Any]:
        """Return, for ManiSkill, the info of the present step as tensors, with what only wrappers read."""
        self._info = {
            **self.read_info(),
            "cue_steps": self._cue_end_step.copy(),
            "delay_steps": self._response_step - self._cue_end_step,
            "oracle_info": self.oracle_info().copy(),
            **self.extra_info(),
        }
        if self.PROMPT_DIMS:
            self._info["task_cue"] = self.prompt().copy()
        info = self._tensors(self._info)
        if self.instruction is not None:
            info["language_instruction"] = [self.instruction] * self.num_envs
        return info

    def _tensors(self, arrays: Mapping[str, Array]) -> dict[str, Any]:
        return {name: torch.as_tensor(array, device=self.device) for name, array in arrays.items()}

    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, Any]:
        extra: dict[str, Array] = {"tcp_pose": self.tcp_pose()}
        if self.obs_mode_struct.use_state:
            extra.update(self._privileged_extra())
        elif self.PROMPT_DIMS:
            extra["task_cue"] = self.prompt().copy()
        return self._tensors(extra)

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict[str, Any]) -> torch.Tensor:
        """Return, for ManiSkill, the (B,) dense reward; its terms are put into `info`."""
        terms = self.reward_terms(self._info)
        info["reward_dict"] = self._tensors(terms)
        return torch.as_tensor(self.dense_reward(terms, self._info), device=self.device)

    def compute_normalized_dense_reward(
        self, obs: Any, action: torch.Tensor, info: dict[str, Any]
    ) -> torch.Tensor:
        """Return the dense reward divided by its value at success."""
        return self.compute_dense_reward(obs, action, info) / self.MAX_REWARD
