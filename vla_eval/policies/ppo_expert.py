"""A learned expert as a policy: sees the true state of the world, decides anew at each control step."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.errors import CheckpointError, SpecMismatchError
from vla_eval.policies.context import PolicyContext
from vla_eval.specs import PolicySpec
from vla_eval.training.ppo_expert import load_expert, read_settings


class PpoExpertPolicy:
    """Plays the most likely action of a checkpoint of `mikasa-vla train-expert`.

    Args:
        context: see `PolicyContext`.
        checkpoint: the folder that `train-expert` wrote.

    Raises:
        CheckpointError: no checkpoint, a damaged one, or one for another task.
    """

    def __init__(self, context: PolicyContext, *, checkpoint: str) -> None:
        torch.set_num_threads(1)
        self._checkpoint = Path(checkpoint)
        self._settings = read_settings(self._checkpoint)
        trained_on = self._settings.task
        if trained_on != context.env.task:
            raise CheckpointError(
                f"{checkpoint}: is an expert for {trained_on}, expected one for {context.env.task}: its "
                f"state holds other things. Train one for it, or evaluate on {trained_on}."
            )
        self._network = load_expert(self._checkpoint)
        self.spec = PolicySpec(
            name=context.name, reads="last", cameras=(), states=(), chunk_size=1, privileged=True
        )

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Nothing is remembered from step to step."""

    @torch.no_grad()
    def act(self, window: ObservationWindow) -> ActionChunk:
        """Decide on one action.

        Raises:
            SpecMismatchError: the observation has no state vector, or one of another length.
        """
        privileged = window.last.privileged
        found = 0 if privileged is None else privileged.state_vector.size
        expected = self._network.spec.n_state
        if privileged is None or found != expected:
            raise SpecMismatchError(
                f"policy '{self.spec.name}' was trained on {expected} numbers of the true state, and the "
                f"environment offers {found}. Use the simulator and task arguments that it was trained with "
                f"({self._checkpoint / 'config.json'})."
            )
        state = torch.from_numpy(privileged.state_vector[None])
        learned = self._network.best_actions(self._network.normalize(state)).numpy()
        return ActionChunk(actions=np.clip(self._settings.full_actions(learned), -1, 1))


def make_ppo_expert(context: PolicyContext, *, checkpoint: str) -> PpoExpertPolicy:
    """Make the policy; the registry's entry."""
    return PpoExpertPolicy(context, checkpoint=checkpoint)
