"""Plain policies as a LeRobot policy: imitation over whole episodes, memory from frame to frame."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple  # lerobot is untyped

import torch
from lerobot.policies.common.flow_matching import euler_integrate, sample_noise
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from torch import Tensor, nn

from vla_eval.features import REWARD_KEY, STATE_KEY, RewardKind
from vla_eval.models.cores.core import CoreMemory
from vla_eval.models.cores.cores import make_core
from vla_eval.models.cores.gated import Gated
from vla_eval.models.cores.sizes import CORES
from vla_eval.models.episodes.config import POSITION_SCALE, SPACE
from vla_eval.models.episodes.policy import EpisodePolicy
from vla_eval.models.episodes.samples import (
    Episodes,
    after_waiting,
    goal_missed,
    stacked_images,
    weighted_mean,
)
from vla_eval.models.episodes.sentence import SentenceEncoder, said_at_each_step, with_sentence
from vla_eval.models.sequence.configuration_sequence import TYPE, MikasaSequenceConfig
from vla_eval.models.sequence.encoders import Cameras
from vla_eval.models.sequence.heads import FlowHead, PrefixReader
from vla_eval.models.shared.precision import in_float32
from vla_eval.models.shared.prefix import Prefix, drawn_lengths, prefix_of

WAITS_SHARE = 0.5  # of the prefixes where the arm rests: so many are of waiting


class Demonstrated(NamedTuple):
    """Returns to go (B, T) and executed actions (B, T, action), which tokens are made of."""

    returns: Tensor
    actions: Tensor


class SequenceNetwork(nn.Module):
    """Encoders of images, tokens for each step, a core over the tokens, a head."""

    def __init__(self, config: MikasaSequenceConfig) -> None:
        super().__init__()
        width, images = config.width, config.image_features
        image_px = int(next(iter(images.values())).shape[-1])
        self.config = config
        self.encoders = Cameras(config.encoder, n_cameras=len(images), image_px=image_px, outputs=width)
        n_state = int(config.robot_state_feature.shape[0]) if config.state_in_token else 0
        self.token = nn.Sequential(
            nn.Linear(self.encoders.outputs + n_state, width), nn.LayerNorm(width), nn.GELU()
        )
        self.core = make_core(
            config.core,
            width=width,
            layers=config.layers,
            heads=config.heads,
            context_steps=config.context_steps,
            dropout=config.dropout,
            tokens_per_step=config.tokens_per_step,
            given=config.core_options,
        )
        self.is_gated = config.head != "linear"
        if self.is_gated:
            self.head = nn.Sequential(Gated(2 * width, width), nn.LayerNorm(width), Gated(width, width))
        self.shape = (config.chunk_size, int(config.action_feature.shape[0]))
        self.flow = FlowHead(width, self.shape) if config.head == "flow" else None
        if self.flow is None:
            self.actions = nn.Linear(width, self.shape[0] * self.shape[1])
            self.prefix = PrefixReader(width, self.shape, prefix_steps=config.prefix_steps)
        self.goal = nn.Linear(width, SPACE)
        if config.reads_returns:
            self.returns = nn.Linear(1, width)
        if config.reads_actions:
            self.executed = nn.Linear(self.shape[1], width)
        self.sentence = SentenceEncoder(width) if config.reads_sentence else None

    def begin(self, n_episodes: int) -> CoreMemory:
        """Return the memory before the first step; its last tensor is the core's answer, (B, width)."""
        nothing = self.goal.weight.new_zeros(n_episodes, self.goal.in_features)
        return (*self.core.begin(n_episodes), nothing)

    def tokens(self, images: Tensor, state: Tensor, said: Tensor | None = None) -> Tensor:
        """Return (B, T, width) of images (B, T, cameras, 3, H, W), in [0, 1] or bytes, and of the rest."""
        return self._told(self.encoders(images), state, said)

    # Under autocast the encoders alone are in half precision: they are nearly all of the work.
    @in_float32
    def _told(self, seen: Tensor, state: Tensor, said: Tensor | None) -> Tensor:
        read = [seen, state * POSITION_SCALE] if self.config.state_in_token else [seen]
        return with_sentence(self.token, torch.cat(read, dim=-1), said)

    @in_float32
    def answers(self, tokens: Tensor, demonstrated: Demonstrated | None) -> Tensor:
        """Return answers (B, T, width) to observations' tokens; other tokens are made of `demonstrated`."""
        begun = self.core.begin(len(tokens))
        if demonstrated is None:
            alone: Tensor = self.core(tokens, begun)[0]
            return alone
        parts = [self.returns(demonstrated.returns[..., None]), tokens]
        if self.config.reads_actions:
            parts.append(self.executed(demonstrated.actions))
        steps = torch.stack(parts, dim=2)
        read: Tensor = self.core(steps.flatten(1, 2), begun)[0]
        return read[:, 1 :: steps.shape[2]]

    @in_float32
    def read(self, tokens: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """Return the core's answers (B, T, width) to observations, and the memory after the last step.

        The return to go is the target at every step: no reward is known. The action, where it is read, is
        the one that the policy itself decides on at the step.
        """
        if not self.config.reads_returns:
            answers, kept = self.core(tokens, memory[:-1])
            return answers, (*kept, answers[:, -1])
        kept, found = memory[:-1], []
        target = tokens.new_full((len(tokens), 1, 1), self.config.return_at_inference)
        for step in range(tokens.shape[1]):
            token = tokens[:, step : step + 1]
            told = torch.cat([self.returns(target), token], dim=1)
            answer, kept = self.core(told, kept)
            found.append(answer[:, 1:])
            if not self.config.reads_actions:
                continue
            action = self.chunks(self.decide(token, found[-1]))[:, :, 0].clamp(-1, 1)
            _, kept = self.core(self.executed(action.to(token.dtype)), kept)
        return torch.cat(found, dim=1), (*kept, found[-1][:, 0])

    @in_float32
    def decide(self, tokens: Tensor, answers: Tensor) -> Tensor:
        """Return what is decided at each step, (B, T, width), as both inputs are."""
        decided: Tensor = self.head(torch.cat([tokens, answers], dim=-1)) if self.is_gated else answers
        return decided

    @in_float32
    def goal_m(self, decided: Tensor) -> Tensor:
        """Return where the demonstration's tool centre point ends, (B, T, 3)."""
        goal: Tensor = self.goal(decided) / POSITION_SCALE
        return goal

    @in_float32
    def chunks(self, decided: Tensor, prefix: Prefix | None = None) -> Tensor:
        """Return chunks (B, T, chunk, action) of a head that makes them at once."""
        actions: Tensor = self.actions(self.prefix(decided, prefix)).unflatten(-1, self.shape)
        actions = actions if self.is_gated else actions.tanh()
        return actions if prefix is None else prefix.put_into(actions)

    @in_float32
    def errors(self, decided: Tensor, actions: Tensor, prefix: Prefix | None) -> Tensor:
        """Return the squared errors (B, T, chunk) of what is learned: actions, or velocities of a flow."""
        if self.flow is not None:
            return self.flow.errors(decided, actions, prefix)
        return (self.chunks(decided, prefix) - actions).square().mean(dim=-1)


class MikasaSequencePolicy(EpisodePolicy):
    """See `MikasaSequenceConfig`; it has a memory if its core has one."""

    config_class = MikasaSequenceConfig
    name = TYPE

    def __init__(self, config: MikasaSequenceConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: MikasaSequenceConfig = config
        self.network = SequenceNetwork(config)
        self.declare_memory(self.network.begin, remembers=CORES[config.core].remembers)
        self.draws_nothing = config.noise_shape is None
        self.rtc_processor: RTCProcessor | None = None

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a batch of training samples, and its parts."""
        config, network = self.config, self.network
        episodes = self.samples(batch, each_motion=config.goal_of_each_motion)
        # Images are most of the work: each is encoded once, those of padding not at all.
        first = episodes.first
        said = said_at_each_step(network.sentence, batch, first.shape[1])
        said = None if said is None else said[first][None]
        encoded = network.tokens(episodes.images[None], episodes.state[first][None], said)[0]
        tokens = encoded[episodes.frames]
        answers = network.answers(tokens, self._demonstrated(batch, episodes))
        decided = network.decide(tokens, answers)
        episodes, prefix = self._with_prefix(episodes)
        counts = episodes.counts if prefix is None else episodes.counts * ~prefix.mask
        imitation = weighted_mean(network.errors(decided, episodes.actions, prefix), counts)
        # Weighted as the actions are: once the arm moves, its motion gives the goal away, and the one frame
        # at which the choice has to be made from memory would count for little.
        goal = goal_missed(network.goal_m(decided), episodes.goal_m, episodes.goal_counts)
        parts = {"imitation": imitation, "goal": goal}
        loss = imitation + config.goal_weight * goal
        return loss, {name: float(part.detach()) for name, part in parts.items()}

    def _with_prefix(self, episodes: Episodes) -> tuple[Episodes, Prefix | None]:
        """Draw what is decided of each chunk; where the arm rests, in half of them, that it waits on.

        A policy that acts with a delay has often decided to wait when the decision comes. No demonstration
        shows that: there the motion begins at once.
        """
        if not self.config.prefix_steps:
            return episodes, None
        lengths = drawn_lengths(episodes.actions, self.config.prefix_steps)
        waits = torch.rand(lengths.shape, device=lengths.device) < WAITS_SHARE
        episodes = after_waiting(episodes, lengths * waits)
        return episodes, prefix_of(episodes.actions, lengths)

    def _demonstrated(self, batch: dict[str, Tensor], episodes: Episodes) -> Demonstrated | None:
        if not self.config.reads_returns:
            return None
        kind: Any = self.config.reward  # the configuration has checked it
        returns = returns_to_go(rewards_in(batch, kind)).gather(1, episodes.steps)
        return Demonstrated(returns=returns, actions=episodes.actions[:, :, 0])

    @torch.no_grad()
    def _remember(self, batch: dict[str, Tensor], memory: CoreMemory | None) -> CoreMemory:
        """Return the memory after the frames (B, T, …) of a batch; None: an episode begins."""
        self.eval()
        state = batch[STATE_KEY]
        before = self.network.begin(len(state)) if memory is None else memory
        said = said_at_each_step(self.network.sentence, batch, state.shape[1])
        tokens = self.network.tokens(stacked_images(batch, self.config), state, said)
        _, after = self.network.read(tokens, before)
        return after

    def supports_rtc(self) -> bool:
        """Whether chunks can be guided by LeRobot's `RTCProcessor`."""
        return self.network.flow is not None

    def init_rtc_processor(self) -> None:
        """Guide chunks as `config.rtc_config` says, as LeRobot's flow policies do."""
        self.rtc_processor = RTCProcessor(self.config.rtc_config)

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Tensor],
        memory: CoreMemory | None = None,
        *,
        noise: Tensor | None = None,
        prefix: Prefix | None = None,
        **rtc: Any,
    ) -> Tensor:
        """Return (B, chunk, action) for one frame per episode, which `memory`, if any, has already.

        `noise` (B, chunk, action): of a flow, None: drawn by torch. `prefix`: rows that are decided, for a
        policy that was trained with prefixes. `rtc`: `inference_delay`, `prev_chunk_left_over` and
        `execution_horizon`, as LeRobot's `RTCProcessor` takes them.
        """
        self.eval()
        self.check_shown(memory)
        images, state = stacked_images(batch, self.config)[:, None], batch[STATE_KEY][:, None]
        tokens = self.network.tokens(images, state, said_at_each_step(self.network.sentence, batch, 1))
        if memory is None:
            _, memory = self.network.read(tokens, self.network.begin(len(tokens)))
        decided = self.network.decide(tokens, memory[-1][:, None])[:, 0]
        if self.network.flow is None:
            return self.network.chunks(decided, prefix).clamp(-1, 1)
        if noise is None:
            noise = sample_noise((len(decided), *self.network.shape), decided.device)
        processor = self.rtc_processor if rtc else None
        return self.network.flow.sample(
            decided,
            noise,
            self.config.num_inference_steps,
            prefix=prefix,
            integrate=partial(euler_integrate, rtc_processor=processor, rtc_enabled=bool(rtc), **rtc),
        ).clamp(-1, 1)


REWARD_PADDING_KEY = f"{REWARD_KEY}_is_pad"


def rewards_in(batch: Mapping[str, Tensor], kind: RewardKind) -> Tensor:
    """Return the rewards (B, T) of a kind at the policy's `reward_delta_indices`, 0 in padding."""
    if REWARD_PADDING_KEY not in batch:
        raise ValueError(
            f"a batch without '{REWARD_KEY}' at several steps: the dataset has no rewards, or the policy's "
            "`reward_delta_indices` name no steps."
        )
    real = ~batch[REWARD_PADDING_KEY]
    rewards = batch[REWARD_KEY].reshape(real.shape).float() * real
    is_sparse = bool(((rewards == 0) | (rewards == 1)).all()) and bool((rewards.sum(dim=1) <= 1).all())
    if kind == "sparse" and not is_sparse:
        raise ValueError(
            f"'{REWARD_KEY}' holds dense rewards, and the policy is trained on sparse ones: train it with "
            "`mikasa-vla finetune`, which serves them, or set policy.reward=dense."
        )
    return rewards


def returns_to_go(rewards: Tensor) -> Tensor:
    """Return sums of rewards (B, T) from each step on (Chen et al. 2021, section 3)."""
    n_steps = rewards.shape[1]
    return rewards @ torch.ones(n_steps, n_steps, device=rewards.device).triu().T
