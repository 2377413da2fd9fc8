"""The network of the positive control: small vision encoders, a gated memory, attention over both.

docs/positive_control.md explains its parts. Memories: the exponential gate of Beck et al. 2024, "xLSTM", and
the minimal gated recurrence of Feng et al. 2024, "Were RNNs All We Needed?", minGRU.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.models.episodes.config import POSITION_SCALE, SPACE, STATE
from vla_eval.models.episodes.samples import last_of
from vla_eval.models.episodes.sentence import SentenceEncoder, with_sentence
from vla_eval.models.memory.action_head import WAY_SCALE_M, ActionHead, JointLayer
from vla_eval.models.memory.goal_layer import GoalLayer
from vla_eval.models.memory.sizes import KNOWN, PLACE, NetworkSizes
from vla_eval.models.memory.vision_encoder import Keys, Likeness, Places, StandingOut, VisionEncoder
from vla_eval.models.shared.precision import in_float32

IMPORTANCE_OF_STANDING_OUT = 4.0  # to begin with: what stands out e^1 more counts e^4 more
INSISTENCE = 5.0
"""To begin with, every other pair of heads mostly keeps the first thing that it saw: what comes later
counts e^-5 as much. A cue comes before the choice; a mean of both would be neither's colour."""
NOTHING = -1e4  # logarithm of a weight of 0, finite


class Answer(NamedTuple):
    """Outputs of the network for each step."""

    actions: Tensor  # (B, T, chunk, action); joint positions in units of `JOINT_UNIT_RAD`
    # (B, T, chunk) > 0, the squared error that is expected of each action. No gradient flows from it
    # into anything but its own layer.
    doubts: Tensor
    # (B, T, 3) where the demonstration's tool centre point ends, predicted from what the memory looked
    # up alone
    goal_m: Tensor
    pointed_m: Tensor  # (B, T, cameras, heads, 3) the same by each look-up alone
    shares: Tensor  # (B, T, cameras, heads) weight of each among those of its camera
    camera_shares: Tensor  # (B, T, cameras) weight of each camera
    evidence: Tensor  # (B, T, cameras, 3) of each camera: what its share is computed from


class Sight(NamedTuple):
    """What is seen at N steps."""

    places: list[Places]  # per camera
    keys: list[Tensor]  # per camera (N, P, key + KNOWN)
    things: Tensor  # (N, cameras · heads, value) what stood out
    summary: Tensor  # (N, hidden)


class Memory(NamedTuple):
    """What is kept from step to step."""

    things: Tensor  # (B, cameras · heads, value) the weighted mean of what was seen
    importance: Tensor  # (B, cameras · heads) logarithm of the sum of its weights
    rest: Tensor  # (B, memory) everything else


class MemoryNetwork(nn.Module):
    """See the module's text; the twin, which does not remember, resets its memory at each step."""

    def __init__(self, sizes: NetworkSizes, *, remembers: bool) -> None:
        super().__init__()
        self.sizes, self.remembers = sizes, remembers
        n, hidden = sizes.cameras, sizes.hidden
        n_things = n * sizes.heads
        # `eyes` is the name in the weights that ship.
        self.eyes = nn.ModuleList(VisionEncoder(sizes) for _ in range(n))
        self.keys = nn.ModuleList(Keys(sizes) for _ in range(n))
        self.standing_out = nn.ModuleList(StandingOut(sizes) for _ in range(n))
        self.likeness = nn.ModuleList(Likeness(sizes) for _ in range(n))
        self.summary = nn.Sequential(
            nn.Linear(sizes.seen + n * sizes.value + STATE, hidden), nn.LayerNorm(hidden), nn.GELU()
        )
        self.importance = nn.Linear(hidden, n_things)
        insisting = [INSISTENCE if head % 4 < 2 else 0.0 for head in range(sizes.heads)]
        self.insists = nn.Parameter(torch.tensor(insisting).repeat(n))
        self.gates = nn.Linear(hidden, sizes.memory)
        self.candidate = nn.Linear(hidden, sizes.memory)
        self.first_rest = nn.Parameter(torch.zeros(sizes.memory))
        self.asks = nn.Linear(sizes.memory, n_things * sizes.key)
        self.goal = GoalLayer(on_arm=sizes.on_arm, heads=sizes.heads)
        kept = sizes.seen + sizes.memory
        self.decides = nn.Sequential(
            nn.Linear(sizes.seen + kept + hidden + STATE + SPACE, hidden),
            nn.LayerNorm(hidden),
            nn.GELU(),
            nn.Linear(hidden, hidden),
            nn.GELU(),
        )
        self.acts = ActionHead(
            hidden=hidden, chunk=sizes.chunk, action=sizes.decided_action, free=sizes.free_translation
        )
        self.joints = JointLayer() if sizes.joint_targets else None
        self.sentence = SentenceEncoder(hidden) if sizes.reads_sentence else None
        with torch.no_grad():
            nn.init.zeros_(self.asks.weight)
            nn.init.zeros_(self.asks.bias)
            # Time scales from 1 step to the longest (chrono initialisation, Tallec & Ollivier 2018).
            longest = math.log(sizes.longest_span_steps)
            self.gates.bias.copy_(-torch.linspace(0, longest, sizes.memory))

    def begin(self, n_episodes: int) -> Memory:
        """Return the memory before the first step: of things there is none, so that they weigh nothing."""
        sizes, like = self.sizes, self.first_rest
        things = like.new_zeros(n_episodes, sizes.cameras * sizes.heads, sizes.value)
        nothing = like.new_full(things.shape[:2], NOTHING)
        return Memory(things, nothing, like.expand(n_episodes, -1))

    def see(self, images: Tensor, state: Tensor, said: Tensor | None = None) -> Sight:
        """Return what is seen in images (N, cameras, 3, H, W) in [0, 1]; what is said is in the summary."""
        return self._sight([eye(images[:, index]) for index, eye in enumerate(self.eyes)], state, said)

    @in_float32
    def _sight(self, places: list[Places], state: Tensor, said: Tensor | None) -> Sight:
        keys = [key(place) for key, place in zip(self.keys, places, strict=True)]
        looks = zip(self.standing_out, places, keys, strict=True)
        things = torch.cat([look(place, key) for look, place, key in looks], dim=1)
        strongest = [place.strongest() for place in places]
        known = torch.cat([things.flatten(1), *strongest, state * POSITION_SCALE], dim=-1)
        return Sight(places, keys, things, with_sentence(self.summary, known, said))

    def write(self, sight: Sight, shape: Sequence[int], memory: Memory) -> Memory:
        """Return the memories (B, T, …) after each of B · T steps, episode by episode; `shape` is (B, T)."""
        seen = (sight.things, sight.summary)
        things, summaries = (part.reshape(*shape, *part.shape[1:]) for part in seen)
        return self._written(things, summaries, memory)

    @in_float32
    def _written(self, things: Tensor, summaries: Tensor, memory: Memory) -> Memory:
        """See `write`; things and summaries are (B, T, …)."""
        apart = things[..., self.sizes.channels]
        importance = self.importance(summaries) + IMPORTANCE_OF_STANDING_OUT * apart
        gates, candidates = self.gates(summaries).sigmoid(), self.candidate(summaries)
        memories = []
        for step in range(summaries.shape[1]):
            before = memory if self.remembers else self.begin(len(summaries))
            held = before.importance > NOTHING / 2  # nothing insists while nothing is held
            weight = importance[:, step] - self.insists * held
            total = torch.logaddexp(before.importance, weight)
            share = (weight - total).exp()
            memory = Memory(
                torch.lerp(before.things, things[:, step], share[..., None]),
                total,
                torch.lerp(before.rest, candidates[:, step], gates[:, step]),
            )
            memories.append(memory)
        return Memory(*(torch.stack(parts, dim=1) for parts in zip(*memories, strict=True)))

    @in_float32
    def act(self, sight: Sight, memory: Memory, state: Tensor) -> Answer:
        """Return the answer for N steps, which `memory` has already; a state begins with the tool's place."""
        sizes = self.sizes
        # Of the learned numbers alone: a thing is looked for as it was seen, in its colour and at its place.
        asked = self.asks(memory.rest).reshape(len(state), sizes.cameras, sizes.heads, -1)
        asked = functional.pad(asked, (0, KNOWN))
        things = memory.things.reshape(len(state), sizes.cameras, sizes.heads, -1)
        found = [
            look(places, keys, key.of(thing) + ask)
            for look, places, keys, key, thing, ask in zip(
                self.likeness,
                sight.places,
                sight.keys,
                self.keys,
                things.unbind(1),
                asked.unbind(1),
                strict=True,
            )
        ]
        values = torch.stack([each.values for each in found], dim=1)
        looked_up = values.flatten(1)
        evidence = torch.stack([each.evidence for each in found], dim=1)
        goals = self.goal(values[..., -PLACE:], evidence, state)
        goal_m = goals.together
        way_m = goal_m.detach() - state[:, :SPACE]
        known = [looked_up, memory.things.flatten(1), memory.rest, sight.summary, state * POSITION_SCALE]
        decided = self.decides(torch.cat([*known, way_m / WAY_SCALE_M], dim=-1))
        actions, doubts = self.acts(decided, way_m)
        if self.joints is not None:
            actions = self.joints(actions, state)
        return Answer(
            actions=actions,
            doubts=doubts,
            goal_m=goal_m,
            pointed_m=goals.pointed,
            shares=goals.shares,
            camera_shares=goals.camera_shares,
            evidence=goals.evidence,
        )

    def forward(self, images: Tensor, state: Tensor, said: Tensor | None = None) -> Answer:
        """Answer for each step of episodes from their beginning, images (B, T, cameras, 3, H, W)."""
        every = torch.ones(state.shape[:2], dtype=torch.bool, device=state.device)
        return self.answers(images.flatten(0, 1), state, said, first=every, real=every)

    def answers(
        self, images: Tensor, state: Tensor, said: Tensor | None, *, first: Tensor, real: Tensor
    ) -> Answer:
        """Answer for each step of padded episodes. Nothing is computed for padding but its memory.

        `images` (N, cameras, 3, H, W) in [0, 1] are those of `first` (B, T), where a frame is shown for the
        first time. `state` (B, T, state) is in SI units. `real` (B, T) is False for padding, which is last.
        """
        sight = self.see(images, state[first], None if said is None else said[first])
        shown = last_of(first)
        memories = self._written(sight.things[shown], sight.summary[shown], self.begin(len(state)))
        at_real = sight if len(images) == int(real.sum()) else _of(sight, shown[real])
        answer = self.act(at_real, Memory(*(part[real] for part in memories)), state[real])
        return Answer(*(part[last_of(real)] for part in answer))


def _of(sight: Sight, steps: Tensor) -> Sight:
    """Return what is seen at these (M,) of the N steps."""
    return Sight(
        [Places(*(part[steps] for part in places)) for places in sight.places],
        [keys[steps] for keys in sight.keys],
        sight.things[steps],
        sight.summary[steps],
    )
