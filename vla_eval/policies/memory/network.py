"""The network of the positive control: small eyes, a gated memory, and a look back through it.

What is seen at a step is summed up by attention at fixed questions and written into a memory; what the
memory asks for is looked up in the pictures of the same step; the answer gives the next actions. The
twin without memory is the same network whose memory begins anew at each step.

The memory is a minimal gated recurrence: gate and candidate depend on the input alone (Feng et al. 2024,
"Were RNNs All We Needed?", minGRU). What was written stays as it was written until it is overwritten, so
that it can be compared with the pictures that come later.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

STATE_SCALE = 5.0  # metres of the workspace to numbers of about 1
GOAL_SCALE_M = (
    0.1  # numbers of about 1 to metres: else a step of the optimizer moves the goal across the table
)
RGB, PLACE, GOAL = 3, 2, 3  # numbers of a colour, of a place in a picture, of a position in space


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
        patch_px: edge of such a place, an even number.
        heads: questions per camera: so many fixed ones, and so many of the memory.
        key: numbers of a question.
        memory: units of the memory.
        hidden: units of the layers between.
        thumbnail_px: edge of the recalled picture of the first step.
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
    thumbnail_px: int = 16
    longest_span_steps: float = 100.0

    @property
    def value(self) -> int:
        """Numbers that attention returns of a place: features, mean colour, coordinates."""
        return self.channels + RGB + PLACE

    @property
    def seen(self) -> int:
        """Numbers that one look at all pictures returns."""
        return self.cameras * self.heads * self.value


class Answer(NamedTuple):
    """What the network says of each step.

    Attributes:
        actions: (B, T, chunk, action).
        goal_m: (B, T, 3) where the demonstration's tool centre point ends, told from what the memory looked
            up alone.
        first_pictures: (B, T, cameras, 3, thumbnail, thumbnail) by how many standard deviations the
            episode's first pictures differ from those of other episodes, told from the memory alone.
    """

    actions: Tensor
    goal_m: Tensor
    first_pictures: Tensor


class Sight(NamedTuple):
    """What is seen at N steps.

    Attributes:
        places: per camera (N, P, value).
        keys: per camera (N, P, key + 5).
        things: (N, cameras · heads, value) what stood out.
        summary: (N, hidden).
    """

    places: list[Tensor]
    keys: list[Tensor]
    things: Tensor
    summary: Tensor


class Eye(nn.Module):
    """One camera's picture to features of places; beside them colour and coordinates of a quarter of each.

    It is the quarter whose hue differs most from the picture's: a cube of 4 pixels keeps its colour in a
    place of 8.
    """

    coordinates: Tensor

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.patch_px = sizes.patch_px
        width = sizes.channels
        self.patches = nn.Conv2d(RGB * sizes.patch_px**2, width, 1)
        self.around = nn.Conv2d(width, width, 3, padding=1)
        self.mix = nn.Conv2d(width, width, 1)
        line = torch.linspace(-1, 1, 2 * sizes.image_px // sizes.patch_px)
        y, x = torch.meshgrid(line, line, indexing="ij")
        self.register_buffer("coordinates", torch.stack([x, y]), persistent=False)

    def forward(self, pictures: Tensor) -> Tensor:
        """(N, 3, H, W) in [0, 1] to (N, places, value)."""
        centred = 2 * pictures - 1
        features = self.patches(functional.pixel_unshuffle(centred, self.patch_px))
        features = features + self.mix(functional.gelu(self.around(functional.gelu(features))))
        colors = functional.avg_pool2d(centred, self.patch_px // 2)
        hues = colors - colors.mean(dim=1, keepdim=True)
        apart = (hues - hues.mean(dim=(2, 3), keepdim=True)).square().sum(dim=1, keepdim=True)
        quarters = functional.max_pool2d(apart, 2, return_indices=True)[1].flatten(2)
        placed = torch.cat([colors, self.coordinates.expand(len(pictures), -1, -1, -1)], dim=1).flatten(2)
        chosen = placed.gather(2, quarters.expand(-1, RGB + PLACE, -1))
        return torch.cat([features.float().flatten(2), chosen], dim=1).transpose(1, 2)


class Keys(nn.Module):
    """What of a place counts when it is looked for: learned numbers, its colour, its coordinates."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.learned = nn.Linear(sizes.value, sizes.key)

    def forward(self, values: Tensor) -> Tensor:
        """(…, value) to (…, key + 5)."""
        return torch.cat([self.learned(values), values[..., -(RGB + PLACE) :]], dim=-1)


class StandingOut(nn.Module):
    """Looks at what differs from the rest of the picture, in a way of its own per head."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        n = sizes.key + RGB + PLACE
        self.towards = nn.Parameter(torch.randn(sizes.heads, n) / math.sqrt(n))
        self.apart = nn.Parameter(torch.zeros(sizes.heads, n))
        with torch.no_grad():  # to begin with, colours that stand out
            self.apart[:, sizes.key : sizes.key + RGB] = 4.0

    def forward(self, places: Tensor, keys: Tensor) -> Tensor:
        """(N, P, value) and (N, P, key + 5) to what each head saw, (N, heads, value)."""
        apart = (keys - keys.mean(dim=1, keepdim=True)).square()
        scores = keys @ self.towards.T + apart @ self.apart.T
        return scores.transpose(1, 2).softmax(dim=-1) @ places


class Likeness(nn.Module):
    """Looks at what is like that which was asked for; each head has its own notion of likeness."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.counts = nn.Parameter(torch.full((sizes.heads, sizes.key + RGB + PLACE), -3.0))
        with torch.no_grad():  # to begin with, half of the heads ask for a colour, half for a place
            self.counts[: sizes.heads // 2, sizes.key : sizes.key + RGB] = 3.0
            self.counts[sizes.heads // 2 :, sizes.key + RGB :] = 3.0

    def forward(self, places: Tensor, keys: Tensor, asked: Tensor) -> Tensor:
        """(N, P, value), (N, P, key + 5), (N, heads, key + 5) to (N, heads, value)."""
        counts = functional.softplus(self.counts)
        # Minus the squared distance, without what all places have in common.
        scores = 2 * keys @ (asked * counts).transpose(1, 2) - keys.square() @ counts.T
        return scores.transpose(1, 2).softmax(dim=-1) @ places


def _in_float32[**P, R](method: Callable[P, R]) -> Callable[P, R]:
    """Keep autocast out: convolutions gain from bfloat16, but places and small steps of memory would lose."""

    @functools.wraps(method)
    def kept(*args: P.args, **kwargs: P.kwargs) -> R:
        network: Any = args[0]
        with torch.autocast(network.first_rest.device.type, enabled=False):
            return method(*args, **kwargs)

    return kept


class Memory(NamedTuple):
    """What is kept from step to step: (B, cameras · heads, value) things seen, and (B, memory) the rest."""

    things: Tensor
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
        n_things, n_key = n * sizes.heads, sizes.key + RGB + PLACE
        self.eyes = nn.ModuleList(Eye(sizes) for _ in range(n))
        self.keys = nn.ModuleList(Keys(sizes) for _ in range(n))
        self.standing_out = nn.ModuleList(StandingOut(sizes) for _ in range(n))
        self.likeness = nn.ModuleList(Likeness(sizes) for _ in range(n))
        self.summary = nn.Sequential(
            nn.Linear(sizes.seen + n * sizes.value + sizes.state, hidden), nn.LayerNorm(hidden), nn.GELU()
        )
        self.gates = nn.Linear(hidden, n_things + sizes.memory)
        self.candidate = nn.Linear(hidden, sizes.memory)
        self.first_things = nn.Parameter(torch.zeros(n_things, sizes.value))
        self.first_rest = nn.Parameter(torch.zeros(sizes.memory))
        self.asks = nn.Linear(sizes.memory, n_things * n_key)
        self.goal = nn.Sequential(nn.Linear(sizes.seen, hidden), nn.GELU(), nn.Linear(hidden, GOAL))
        kept = sizes.seen + sizes.memory
        self.acts = nn.Sequential(
            nn.Linear(sizes.seen + kept + hidden + sizes.state + GOAL, hidden),
            nn.LayerNorm(hidden),
            nn.GELU(),
            nn.Linear(hidden, hidden),
            nn.GELU(),
            nn.Linear(hidden, sizes.chunk * sizes.action),
        )
        self.recalls = nn.Sequential(
            nn.Linear(kept, hidden), nn.GELU(), nn.Linear(hidden, n * RGB * sizes.thumbnail_px**2)
        )
        with torch.no_grad():
            nn.init.zeros_(self.asks.weight)
            nn.init.zeros_(self.asks.bias)
            # Time scales from 1 step to the longest (chrono initialisation, Tallec & Ollivier 2018).
            longest = math.log(sizes.longest_span_steps)
            self.gates.bias[:n_things] = -2.0
            self.gates.bias[n_things:] = -torch.linspace(0, longest, sizes.memory)

    def begin(self, n_episodes: int) -> Memory:
        """Return the memory before the first step."""
        return Memory(self.first_things.expand(n_episodes, -1, -1), self.first_rest.expand(n_episodes, -1))

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
        gates, candidates = self.gates(summaries).sigmoid(), self.candidate(summaries)
        n_things = things.shape[2]
        memories = []
        for step in range(summaries.shape[1]):
            before = memory if self.remembers else self.begin(len(summaries))
            gate = gates[:, step]
            memory = Memory(
                torch.lerp(before.things, things[:, step], gate[:, :n_things, None]),
                torch.lerp(before.rest, candidates[:, step], gate[:, n_things:]),
            )
            memories.append(memory)
        return Memory(
            torch.stack([one.things for one in memories], dim=1),
            torch.stack([one.rest for one in memories], dim=1),
        )

    @_in_float32
    def act(self, sight: Sight, memory: Memory, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions (N, chunk, action) and goal (N, 3) for N steps whose memory is written."""
        sizes = self.sizes
        asked = self.asks(memory.rest).reshape(len(state), sizes.cameras, sizes.heads, -1)
        things = memory.things.reshape(len(state), sizes.cameras, sizes.heads, -1)
        found = [
            look(sight.places[index], sight.keys[index], self.keys[index](things[:, index]) + asked[:, index])
            for index, look in enumerate(self.likeness)
        ]
        looked_up = torch.cat(found, dim=1).flatten(1)
        goal = GOAL_SCALE_M * self.goal(looked_up)
        known = [looked_up, memory.things.flatten(1), memory.rest, sight.summary, state * STATE_SCALE]
        actions = self.acts(torch.cat([*known, goal.detach()], dim=-1))
        return actions.reshape(-1, sizes.chunk, sizes.action), goal

    def forward(self, pictures: Tensor, state: Tensor) -> Answer:
        """Answer for each step of episodes from their beginning.

        Args:
            pictures: (B, T, cameras, 3, H, W) in [0, 1].
            state: (B, T, state) in SI units.
        """
        shape, sizes = state.shape[:2], self.sizes
        flat_state = state.flatten(0, 1)
        sight = self.see(pictures.flatten(0, 1), flat_state)
        memories = self.write(sight, shape, self.begin(shape[0]))
        flat = Memory(memories.things.flatten(0, 1), memories.rest.flatten(0, 1))
        actions, goal = self.act(sight, flat, flat_state)
        thumbnails = self.recalls(torch.cat([flat.things.flatten(1), flat.rest], dim=-1))
        size = (sizes.cameras, RGB, sizes.thumbnail_px, sizes.thumbnail_px)
        return Answer(
            actions=by_episode(actions, shape),
            goal_m=by_episode(goal, shape),
            first_pictures=thumbnails.reshape(*shape, *size),
        )


def by_episode(steps: Tensor, shape: Sequence[int]) -> Tensor:
    """Return (B · T, …) as (B, T, …), `shape` being (B, T)."""
    return steps.reshape(*shape, *steps.shape[1:])
