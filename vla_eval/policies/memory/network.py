"""The network of the positive control: small eyes, a gated memory, and a look back through it.

What stands out at a step is written into a memory; what the memory holds is looked up in the pictures of
the same step; the answer gives the next actions. The twin without memory is the same network whose memory
begins anew at each step.

Things are kept as they were seen, so that they can be compared with the pictures that come later: the
memory of a thing is the mean of all that was seen, each weighted by the exponential of a learned
importance (exponential gating: Beck et al. 2024, "xLSTM"). All else is kept in a minimal gated recurrence,
whose gate and candidate depend on the input alone (Feng et al. 2024, "Were RNNs All We Needed?", minGRU).
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.policies.memory.action_head import SPACE, WAY_SCALE_M, ActionHead

STATE_SCALE = 5.0  # metres of the workspace to numbers of about 1
GOAL_SCALE_M = (
    0.1  # numbers of about 1 to metres: else a step of the optimizer moves the goal across the table
)
IMPORTANCE_OF_STANDING_OUT = 4.0  # to begin with: what stands out e^1 more counts e^4 more
NOTHING = -1e4  # logarithm of a weight of 0, finite
RGB, PLACE = 3, 2  # numbers of a colour, of a place in a picture
APART = 1  # one number: how much a place stands out
KNOWN = APART + RGB + PLACE  # what is told of a place beside its learned features, in this order
SPOTS = 4  # spots along a place's edge
LEAST_COLOR_VARIANCE = 1e-3  # colours in [-1, 1]: less than this is noise of the picture


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkSizes:
    """Sizes of the network.

    Attributes:
        cameras: pictures of a step.
        image_px: height and width of a picture, a multiple of `patch_px`.
        state: numbers of proprioception.
        action: dimensions of an action.
        chunk: actions of a chunk.
        channels: learned features of a place in a picture.
        patch_px: edge of such a place, a multiple of `SPOTS`.
        heads: questions per camera: so many fixed ones, and so many of the memory.
        key: numbers of a question.
        memory: units of the memory.
        hidden: units of the layers between.
        longest_span_steps: the slowest units of the memory begin with a time scale of so many steps.
    """

    cameras: int = 2
    image_px: int = 128
    state: int = 10
    action: int = 7
    chunk: int = 8
    channels: int = 32
    patch_px: int = 4
    heads: int = 8
    key: int = 16
    memory: int = 256
    hidden: int = 256
    longest_span_steps: float = 100.0

    @property
    def value(self) -> int:
        """Numbers that attention returns of a place: features, standing out, colour, coordinates."""
        return self.channels + KNOWN

    @property
    def seen(self) -> int:
        """Numbers that one look at all pictures returns."""
        return self.cameras * self.heads * self.value


class Answer(NamedTuple):
    """What the network says of each step.

    Attributes:
        actions: (B, T, chunk, action).
        doubts: (B, T, chunk) > 0, the squared error that is expected of each action. No gradient flows from
            it into anything but its own layer.
        goal_m: (B, T, 3) where the demonstration's tool centre point ends, told from what the memory looked
            up alone.
    """

    actions: Tensor
    doubts: Tensor
    goal_m: Tensor


class Sight(NamedTuple):
    """What is seen at N steps.

    Attributes:
        places: per camera (N, P, value).
        keys: per camera (N, P, key + KNOWN).
        things: (N, cameras · heads, value) what stood out.
        summary: (N, hidden).
    """

    places: list[Tensor]
    keys: list[Tensor]
    things: Tensor
    summary: Tensor


def _in_float32[**P, R](method: Callable[P, R]) -> Callable[P, R]:
    """Keep autocast out: convolutions gain from bfloat16, but places and small steps of memory would lose."""

    @functools.wraps(method)
    def kept(*args: P.args, **kwargs: P.kwargs) -> R:
        module: Any = args[0]
        with torch.autocast(next(module.parameters()).device.type, enabled=False):
            return method(*args, **kwargs)

    return kept


class Eye(nn.Module):
    """One camera's picture to features of places; beside them what is known of one spot of each.

    It is the spot, a quarter of the place's edge wide, whose colour stands out most from the picture's: a
    cube of 4 pixels keeps its colour in a place of 8.
    """

    coordinates: Tensor

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.patch_px = sizes.patch_px
        width = sizes.channels
        self.patches = nn.Conv2d(RGB, width, sizes.patch_px, stride=sizes.patch_px)
        self.around = nn.Conv2d(width, width, 3, padding=1)
        self.mix = nn.Conv2d(width, width, 1)
        line = torch.linspace(-1, 1, SPOTS * sizes.image_px // sizes.patch_px)
        y, x = torch.meshgrid(line, line, indexing="ij")
        self.register_buffer("coordinates", torch.stack([x, y]), persistent=False)

    def forward(self, pictures: Tensor) -> Tensor:
        """(N, 3, H, W) in [0, 1] to (N, places, value)."""
        centred = 2 * pictures - 1
        features = self.patches(centred)
        features = features + self.mix(functional.gelu(self.around(functional.gelu(features))))
        return torch.cat([features.float().flatten(2), self._known(centred)], dim=1).transpose(1, 2)

    @torch.no_grad()
    @_in_float32
    def _known(self, pictures: Tensor) -> Tensor:
        """(N, 3, H, W) in [-1, 1] to (N, KNOWN, places)."""
        colors = functional.avg_pool2d(pictures.float(), self.patch_px // SPOTS)
        apart = standing_out(colors)
        spots = functional.max_pool2d(apart, SPOTS, return_indices=True)[1].flatten(2)
        placed = self.coordinates.expand(len(pictures), -1, -1, -1)
        known = torch.cat([apart, colors, placed], dim=1).flatten(2)
        return known.gather(2, spots.expand(-1, KNOWN, -1))


def standing_out(colors: Tensor) -> Tensor:
    """Return (N, 1, H, W): how unlike a picture's other colours each colour (N, 3, H, W) is.

    Half the logarithm of 1 + its squared Mahalanobis distance from the picture's mean, as in the anomaly
    detector of Reed and Yu (1990). A red cube on an orange table is about as bright and nearly as red as its
    surroundings; in units of how colours vary there it is far away.
    """
    apart = colors.flatten(2) - colors.flatten(2).mean(dim=2, keepdim=True)
    variance = apart @ apart.transpose(1, 2) / apart.shape[2]
    variance = variance + LEAST_COLOR_VARIANCE * torch.eye(RGB, dtype=colors.dtype, device=colors.device)
    squared: Tensor = (apart * torch.linalg.solve(variance, apart)).sum(dim=1)
    return squared.log1p().div(2).reshape(len(colors), 1, *colors.shape[2:])


class Keys(nn.Module):
    """What of a place counts when it is looked for: learned numbers, and what is known of it."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.learned = nn.Linear(sizes.value, sizes.key)

    def forward(self, values: Tensor) -> Tensor:
        """(…, value) to (…, key + KNOWN)."""
        return torch.cat([self.learned(values), values[..., -KNOWN:]], dim=-1)


class StandingOut(nn.Module):
    """Looks at what stands out of the picture, in a way of its own per head."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        n = sizes.key + KNOWN
        self.towards = nn.Parameter(torch.randn(sizes.heads, n) / math.sqrt(n))
        with torch.no_grad():  # to begin with: what stands out e^1 more gets e^8 of the attention
            self.towards[:, sizes.key] += 8.0

    def forward(self, places: Tensor, keys: Tensor) -> Tensor:
        """(N, P, value) and (N, P, key + KNOWN) to what each head saw, (N, heads, value)."""
        return (keys @ self.towards.T).transpose(1, 2).softmax(dim=-1) @ places


class Likeness(nn.Module):
    """Looks at what is like that which was asked for; each head has its own notion of likeness."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.counts = nn.Parameter(torch.full((sizes.heads, sizes.key + KNOWN), -3.0))
        color = sizes.key + APART
        with torch.no_grad():  # to begin with, half of the heads ask for a colour, half for a place
            self.counts[:, sizes.key] = 3.0
            self.counts[: sizes.heads // 2, color : color + RGB] = 3.0
            self.counts[sizes.heads // 2 :, color + RGB :] = 3.0

    def forward(self, places: Tensor, keys: Tensor, asked: Tensor) -> Tensor:
        """(N, P, value), (N, P, key + KNOWN), (N, heads, key + KNOWN) to (N, heads, value)."""
        counts = functional.softplus(self.counts)
        # Minus the squared distance, without what all places have in common.
        scores = 2 * keys @ (asked * counts).transpose(1, 2) - keys.square() @ counts.T
        return scores.transpose(1, 2).softmax(dim=-1) @ places


class Memory(NamedTuple):
    """What is kept from step to step.

    Attributes:
        things: (B, cameras · heads, value) the weighted mean of what was seen.
        importance: (B, cameras · heads) logarithm of the sum of its weights.
        rest: (B, memory) everything else.
    """

    things: Tensor
    importance: Tensor
    rest: Tensor


class MemoryNetwork(nn.Module):
    """See the module's text.

    Args:
        sizes: of all layers.
        remembers: False for the twin, whose memory begins anew at each step.
    """

    def __init__(self, sizes: NetworkSizes, *, remembers: bool) -> None:
        super().__init__()
        self.sizes, self.remembers = sizes, remembers
        n, hidden = sizes.cameras, sizes.hidden
        n_things, n_key = n * sizes.heads, sizes.key + KNOWN
        self.eyes = nn.ModuleList(Eye(sizes) for _ in range(n))
        self.keys = nn.ModuleList(Keys(sizes) for _ in range(n))
        self.standing_out = nn.ModuleList(StandingOut(sizes) for _ in range(n))
        self.likeness = nn.ModuleList(Likeness(sizes) for _ in range(n))
        self.summary = nn.Sequential(
            nn.Linear(sizes.seen + n * sizes.value + sizes.state, hidden), nn.LayerNorm(hidden), nn.GELU()
        )
        self.importance = nn.Linear(hidden, n_things)
        self.gates = nn.Linear(hidden, sizes.memory)
        self.candidate = nn.Linear(hidden, sizes.memory)
        self.first_rest = nn.Parameter(torch.zeros(sizes.memory))
        self.asks = nn.Linear(sizes.memory, n_things * n_key)
        self.goal = nn.Sequential(nn.Linear(sizes.seen, hidden), nn.GELU(), nn.Linear(hidden, SPACE))
        kept = sizes.seen + sizes.memory
        self.decides = nn.Sequential(
            nn.Linear(sizes.seen + kept + hidden + sizes.state + SPACE, hidden),
            nn.LayerNorm(hidden),
            nn.GELU(),
            nn.Linear(hidden, hidden),
            nn.GELU(),
        )
        self.acts = ActionHead(hidden=hidden, chunk=sizes.chunk, action=sizes.action)
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

    def see(self, pictures: Tensor, state: Tensor) -> Sight:
        """Return what is seen at each step.

        Args:
            pictures: (N, cameras, 3, H, W) in [0, 1].
            state: (N, state) in SI units.
        """
        return self._sight([eye(pictures[:, index]) for index, eye in enumerate(self.eyes)], state)

    @_in_float32
    def _sight(self, places: list[Tensor], state: Tensor) -> Sight:
        keys = [key(place) for key, place in zip(self.keys, places, strict=True)]
        looks = zip(self.standing_out, places, keys, strict=True)
        things = torch.cat([look(place, key) for look, place, key in looks], dim=1)
        strongest = [place.amax(dim=1) for place in places]
        known = torch.cat([things.flatten(1), *strongest, state * STATE_SCALE], dim=-1)
        return Sight(places, keys, things, self.summary(known))

    @_in_float32
    def write(self, sight: Sight, shape: Sequence[int], memory: Memory) -> Memory:
        """Return the memories (B, T, …) after each step of what was seen at B · T steps.

        Args:
            sight: of all steps, episode by episode.
            shape: (B, T).
            memory: before the first of these steps.
        """
        things, summaries = by_episode(sight.things, shape), by_episode(sight.summary, shape)
        apart = things[..., self.sizes.channels]
        importance = self.importance(summaries) + IMPORTANCE_OF_STANDING_OUT * apart
        gates, candidates = self.gates(summaries).sigmoid(), self.candidate(summaries)
        memories = []
        for step in range(summaries.shape[1]):
            before = memory if self.remembers else self.begin(len(summaries))
            total = torch.logaddexp(before.importance, importance[:, step])
            share = (importance[:, step] - total).exp()
            memory = Memory(
                torch.lerp(before.things, things[:, step], share[..., None]),
                total,
                torch.lerp(before.rest, candidates[:, step], gates[:, step]),
            )
            memories.append(memory)
        return Memory(*(torch.stack(parts, dim=1) for parts in zip(*memories, strict=True)))

    @_in_float32
    def act(self, sight: Sight, memory: Memory, state: Tensor) -> Answer:
        """Return actions (N, chunk, action), doubts (N, chunk) and goal (N, 3) for N steps.

        Args:
            sight: of these steps.
            memory: with these steps written into it.
            state: (N, state) in SI units, the tool centre point's position first.
        """
        sizes = self.sizes
        asked = self.asks(memory.rest).reshape(len(state), sizes.cameras, sizes.heads, -1)
        things = memory.things.reshape(len(state), sizes.cameras, sizes.heads, -1)
        found = [
            look(sight.places[index], sight.keys[index], self.keys[index](things[:, index]) + asked[:, index])
            for index, look in enumerate(self.likeness)
        ]
        looked_up = torch.cat(found, dim=1).flatten(1)
        goal = GOAL_SCALE_M * self.goal(looked_up)
        way_m = goal.detach() - state[:, :SPACE]
        known = [looked_up, memory.things.flatten(1), memory.rest, sight.summary, state * STATE_SCALE]
        decided = self.decides(torch.cat([*known, way_m / WAY_SCALE_M], dim=-1))
        actions, doubts = self.acts(decided, way_m)
        return Answer(actions=actions, doubts=doubts, goal_m=goal)

    def forward(self, pictures: Tensor, state: Tensor) -> Answer:
        """Answer for each step of episodes from their beginning.

        Args:
            pictures: (B, T, cameras, 3, H, W) in [0, 1].
            state: (B, T, state) in SI units.
        """
        shape = state.shape[:2]
        flat_state = state.flatten(0, 1)
        sight = self.see(pictures.flatten(0, 1), flat_state)
        memories = self.write(sight, shape, self.begin(shape[0]))
        flat = Memory(*(part.flatten(0, 1) for part in memories))
        return Answer(*(by_episode(part, shape) for part in self.act(sight, flat, flat_state)))


def by_episode(steps: Tensor, shape: Sequence[int]) -> Tensor:
    """Return (B · T, …) as (B, T, …), `shape` being (B, T)."""
    return steps.reshape(*shape, *steps.shape[1:])
