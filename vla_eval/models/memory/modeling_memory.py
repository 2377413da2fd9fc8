"""The positive control as a LeRobot policy: loss over whole episodes, memory from frame to frame."""

from typing import Any  # lerobot is untyped

import torch
from torch import Tensor

from vla_eval.features import ACTION_KEY, STATE_KEY
from vla_eval.models.episodes.policy import EpisodePolicy
from vla_eval.models.episodes.samples import (
    SAME_ACTION,
    Episodes,
    count_motions,
    goal_missed,
    goal_variance,
    stacked_images,
    weighted_mean,
)
from vla_eval.models.episodes.sentence import said_at_each_step
from vla_eval.models.memory.action_head import action_units
from vla_eval.models.memory.configuration_memory import TYPE, MikasaMemoryConfig
from vla_eval.models.memory.goal_layer import by_camera
from vla_eval.models.memory.network import Answer, Memory, MemoryNetwork
from vla_eval.models.memory.sizes import NetworkSizes
from vla_eval.models.shared.images import in_numbers
from vla_eval.models.shared.network_sizes import sizes_from

SAME_JOINTS = 0.05  # of joints, in units of the network: noise also moves an arm that holds still
UNFORESEEN = 0.05  # root of a mean squared error of actions in [-1, 1]


class MikasaMemoryPolicy(EpisodePolicy):
    """See `MikasaMemoryConfig`; the twin has no memory."""

    config_class = MikasaMemoryConfig
    name = TYPE
    units: Tensor

    def __init__(self, config: MikasaMemoryConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: MikasaMemoryConfig = config
        sizes = network_sizes(config)
        self.network = MemoryNetwork(sizes, remembers=config.remembers)
        units = action_units(joint_targets=sizes.joint_targets, action=sizes.action)
        self.register_buffer("units", units, persistent=False)
        self.declare_memory(self.network.begin, remembers=config.remembers)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a batch of training samples, and its parts."""
        config = self.config
        scaled = {**batch, ACTION_KEY: batch[ACTION_KEY] / self.units}
        same = SAME_JOINTS if config.joint_targets else SAME_ACTION
        episodes = self.samples(scaled, same_action=same)
        said = said_at_each_step(self.network.sentence, batch, episodes.state.shape[1])
        first, real = episodes.first, episodes.real
        images = in_numbers(episodes.images)
        answer = self.network.answers(images, episodes.state, said, first=first, real=real)
        errors = (answer.actions - episodes.actions).square().mean(dim=-1)
        imitation = weighted_mean(errors, episodes.counts)
        has_goal = real & self._has_one_goal(batch)[:, None] if config.goal_of_one_motion else real
        goal, goals = goals_missed(answer, episodes.goal_m[:, -1], has_goal.float())
        if self.training and has_goal.any():
            self._note_errors(answer, episodes, has_goal)
        # The mean of an exponential distribution, by its likelihood: errors of all sizes count alike.
        surprises = errors.detach() / answer.doubts + answer.doubts.log()
        surprise = weighted_mean(surprises, episodes.counts)
        loss = imitation + config.goal_weight * goals + config.doubt_weight * surprise
        parts = {"imitation": imitation, "goal": goal, "surprise": surprise}
        return loss, {name: float(part.detach()) for name, part in parts.items()}

    def _has_one_goal(self, batch: dict[str, Tensor]) -> Tensor:
        """Return (B,): whether the arm begins to move once in an episode."""
        n_steps = self.config.n_window_steps
        actions, is_pad = batch[ACTION_KEY][:, :n_steps], batch[f"{STATE_KEY}_is_pad"][:, :n_steps]
        return count_motions(actions, ~is_pad) <= 1

    @torch.no_grad()
    def _note_errors(self, answer: Answer, episodes: Episodes, real: Tensor) -> None:
        missed = by_camera(answer.pointed_m, answer.shares) - episodes.goal_m[:, :, None]
        self.network.goal.note_errors(missed[real], answer.evidence[real], episodes.state[real])

    @torch.no_grad()
    def _remember(self, batch: dict[str, Tensor], memory: Memory | None) -> Memory:
        """Return the memory after the frames (B, T, …) of a batch; None: an episode begins."""
        images, state = stacked_images(batch, self.config), batch[STATE_KEY]
        shape = state.shape[:2]
        said = said_at_each_step(self.network.sentence, batch, shape[1])
        flat = None if said is None else said.flatten(0, 1)
        sight = self.network.see(images.flatten(0, 1), state.flatten(0, 1), flat)
        before = self.network.begin(shape[0]) if memory is None else memory
        after = self.network.write(sight, shape, before)
        return Memory(*(part[:, -1] for part in after))

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Tensor], memory: Memory | None = None, **kwargs: Any
    ) -> Tensor:
        """Return (B, chunk, action) for one frame per episode, which `memory`, if any, has already."""
        self.eval()
        self.check_shown(memory)
        images, state = stacked_images(batch, self.config), batch[STATE_KEY]
        said = said_at_each_step(self.network.sentence, batch, 1)
        sight = self.network.see(images, state, None if said is None else said[:, 0])
        if memory is None:
            after = self.network.write(sight, (len(state), 1), self.network.begin(len(state)))
            memory = Memory(*(part[:, 0] for part in after))
        foreseen = foreseen_alone(
            self.network.act(sight, memory, state), holds_by_zero=not self.config.joint_targets
        )
        return foreseen * self.units if self.config.joint_targets else foreseen.clamp(-1, 1)


def foreseen_alone(answer: Answer, *, holds_by_zero: bool = True) -> Tensor:
    """Return the actions (B, chunk, action) of an answer, held from the first that is a guess.

    A guess is an action whose error is expected to be larger by `UNFORESEEN` than that of the chunk's first
    (docs/positive_control.md). Held: no motion (zeros, or the last action foreseen), the gripper as it was.
    """
    doubts = answer.doubts.sqrt()
    foreseen = (doubts <= doubts[:, :1] + UNFORESEEN).long().cumprod(dim=1)
    last = (foreseen.sum(dim=1) - 1)[:, None, None]
    held = answer.actions.take_along_dim(last, dim=1).clone()
    if holds_by_zero:
        held[..., :-1] = 0
    return torch.where(foreseen.bool()[..., None], answer.actions, held)


def goals_missed(answer: Answer, right_m: Tensor, real: Tensor) -> tuple[Tensor, Tensor]:
    """Return by how much the goal of an answer (B, T) misses `right_m` (B, 3), and the loss that teaches it.

    In units of what the mean of the batch's goals would miss, squared. In the loss each look-up and each
    camera answers for itself (Jacobs et al. 1991, "Adaptive Mixtures of Local Experts"). `real`: what counts.
    """
    of_look_ups = (answer.pointed_m - right_m[:, None, None, None]).square().mean(dim=-1)
    of_cameras = (answer.shares * of_look_ups).sum(dim=-1)
    by_all = (answer.camera_shares * of_cameras).sum(dim=-1)
    loss = weighted_mean((by_all + of_cameras.mean(dim=-1)) / 2, real) / goal_variance(right_m)
    return goal_missed(answer.goal_m, right_m[:, None], real), loss


def network_sizes(config: MikasaMemoryConfig) -> NetworkSizes:
    """Return the sizes that a configuration and its fields ask for."""
    images = config.image_features
    return sizes_from(
        NetworkSizes,
        config,
        on_arm=tuple(name in config.arm_cameras for name in images),
        image_px=int(next(iter(images.values())).shape[-1]),
        action=int(config.action_feature.shape[0]),
        chunk=config.chunk_size,
    )
