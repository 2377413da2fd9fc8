"""Episodes to train on from a batch of lerobot's loader: the steps moved together, and how each counts."""

from typing import NamedTuple  # lerobot is untyped

import torch
from torch import Tensor

from vla_eval.features import ACTION_KEY, ACTION_PADDING_KEY, STATE_KEY
from vla_eval.models.episodes.color_objects import changed_things
from vla_eval.models.episodes.config import SPACE, EpisodeConfig
from vla_eval.models.shared.images import in_bytes, in_numbers
from vla_eval.models.shared.ported_config import PortedConfig

LEAST_VARIANCE_M2 = 1e-6
LEAST_WEIGHT = 1e-12
SAME_ACTION = 1e-3  # actions that differ by less are waiting
AT_REST_M = 0.03
"""An arm that has waited is still so near to where it was when the episode began: it settles, and noise in
demonstrations (`action_noise`) moves it, by up to 18 mm in 95 of 100 of RememberColor3. A motion takes it as
far in one control step."""
MOTION_BEGINS = 0.5
"""By so much more than the one before it, in units of the controller's limits, a translation moves the arm
where a motion begins. Then all of 1,500 demonstrations of six tasks with one place to go to have one motion;
of 750 with three cubes to touch, 731 have three, the others two."""


class Episodes(NamedTuple):
    """A batch of B episodes of T steps, from their beginning; padding comes last."""

    # (N, cameras, 3, H, W), as they were handed over (see `in_numbers`): those of `first`, one episode
    # after the other. Most of (B, T) is padding, and images are nearly all of the work.
    images: Tensor
    first: Tensor  # (B, T) where a frame is shown for the first time; False for padding
    state: Tensor  # (B, T, state)
    actions: Tensor  # (B, T, chunk, action)
    counts: Tensor  # (B, T, chunk) float, 0 for what is beyond the episode
    goal_counts: Tensor  # (B, T) float, how much the goal counts at each step
    # (B, T, 3) the tool centre point where the episode ends, or the motion that a step is in or comes before
    goal_m: Tensor
    steps: Tensor  # (B, T) which step of the window each is
    # (B, T) whether the arm has only waited before this step, so that waiting on leaves the world as it is
    rests: Tensor
    waiting: Tensor  # (B, action) the action it waited with, where it did

    @property
    def frames(self) -> Tensor:
        """(B, T) which of `images` each step shows; padding shows the last one of its episode."""
        return last_of(self.first)

    @property
    def real(self) -> Tensor:
        """(B, T) False for padding: the first action of a chunk counts at every other step."""
        return self.counts.sum(dim=-1) > 0


def after_waiting(episodes: Episodes, n_rows: Tensor) -> Episodes:
    """Return them with chunks that begin with `n_rows` (B, T) more of waiting, where the arm rests."""
    chunk = episodes.actions.shape[2]
    rows = torch.arange(chunk, device=n_rows.device) - (n_rows * episodes.rests)[..., None]
    moved = rows.clamp(min=0)
    actions = episodes.actions.gather(2, moved[..., None].expand_as(episodes.actions))
    waits = (rows < 0)[..., None]
    return episodes._replace(
        actions=torch.where(waits, episodes.waiting[:, None, None], actions),
        counts=episodes.counts.gather(2, moved),
    )


def last_of(chosen: Tensor) -> Tensor:
    """Return (B, T): which of the chosen steps, episode by episode, each step is or comes after."""
    return chosen.flatten().cumsum(dim=0).sub(1).reshape(chosen.shape)


def stacked_images(batch: dict[str, Tensor], config: PortedConfig) -> Tensor:
    """Return the images (…, cameras, 3, H, W), in the order of the configuration."""
    return torch.stack([batch[key] for key in config.image_features], dim=-4)


def episodes_of(
    batch: dict[str, Tensor],
    config: EpisodeConfig,
    *,
    training: bool,
    same_action: float = SAME_ACTION,
    may_stay: float = 1.0,
    each_motion: bool = False,
) -> Episodes:
    """Return the steps to train on, moved together: those of the episode, most waiting left out.

    In training, at random by torch's generator: waiting is left out, some episodes end at a decision, things
    and colours change and images move. Otherwise every step is taken. Images are in [0, 1], or bytes; actions
    that differ by less than `same_action` are waiting. With `each_motion` each motion has a goal and begins
    with a decision, whether the arm waited before it or not.
    """
    n_steps = config.n_window_steps
    real = ~batch[f"{STATE_KEY}_is_pad"][:, :n_steps]
    actions = batch[ACTION_KEY].unfold(1, config.chunk_size, 1).transpose(-1, -2)
    change = _change(actions[:, :, 0], real)
    waits = change < same_action
    begins = _begins(waits, real)
    motions = _motions(actions[:, :, 0], real) if each_motion else torch.zeros_like(begins)
    begins = begins | motions
    kept = _kept(waits, begins, real, config) if training else real
    counts = (~batch[ACTION_PADDING_KEY]).float().unfold(1, config.chunk_size, 1)
    can_know = torch.ones_like(change)
    if config.masks_beyond_decision:
        before = _before_the_next(begins, config.chunk_size)
        if config.waits_beyond_decision:
            actions = _waiting_beyond(actions, before)
        else:
            counts = counts * before
        can_know = ((begins.cumsum(dim=1) > 0) | ~begins.any(dim=1, keepdim=True)).float()
    counts = (
        counts * _shares(config, actions) * (1 + config.change_weight * change)[..., None] * kept[..., None]
    )
    steps, share = _shown(kept, begins, config.late_steps if training else 0)
    rows = torch.arange(len(steps), device=steps.device)[:, None]

    def taken(values: Tensor) -> Tensor:
        return values[rows, steps]

    counts = taken(counts) * share[..., None]
    first = _first(steps, share > 0)
    episodes = rows.expand_as(steps)[first]
    images = torch.stack([batch[key][episodes, steps[first]] for key in config.image_features], dim=1)
    if training and (config.exchange_share or config.erase_share):
        decision = begins.int().argmax(dim=1)  # 0: there is none
        empty = torch.stack([batch[key][rows[:, 0], decision - 1] for key in config.image_features], dim=1)
        n_before = (first & (steps < decision[:, None])).sum(dim=1)
        images = _with_other_things(images, first.sum(dim=1), n_before, empty, config, may_stay)
    return Episodes(
        images=_augmented(images, episodes, config, n_episodes=len(steps)) if training else images,
        first=first,
        state=taken(batch[STATE_KEY][:, :n_steps]),
        actions=taken(actions),
        counts=counts,
        goal_counts=counts.sum(dim=-1) * taken(can_know),
        goal_m=taken(_goals_m(batch[STATE_KEY][..., :SPACE], motions)),
        steps=steps,
        rests=taken(_rests(waits, batch[STATE_KEY][:, :n_steps, :SPACE])),
        waiting=actions[:, 0, 0],
    )


def _rests(waits: Tensor, place_m: Tensor) -> Tensor:
    """Return (B, T): whether all actions before a step were the same, and the tool hardly moved."""
    waited = torch.zeros_like(waits)  # not known of the first step, which has no action before it
    waited[:, 1:] = True
    waited[:, 2:] = waits[:, 1:-1].cumprod(dim=1).bool()
    away_m = (place_m - place_m[:, :1]).norm(dim=-1).cummax(dim=1).values
    rests: Tensor = waited & (away_m < AT_REST_M)
    return rests


def count_motions(actions: Tensor, real: Tensor) -> Tensor:
    """Return (B,): how often the arm begins to move; actions (B, T, action) begin with a translation."""
    return _motions(actions, real).sum(dim=1)


def _motions(actions: Tensor, real: Tensor) -> Tensor:
    """Return (B, T): whether the arm begins to move at a step, whatever it did before."""
    sizes = actions[..., :SPACE].norm(dim=-1) * real
    rises = sizes.diff(dim=1, prepend=torch.zeros_like(sizes[:, :1]))
    begins: Tensor = rises > MOTION_BEGINS
    return begins


def _goals_m(places_m: Tensor, motions: Tensor) -> Tensor:
    """Return (B, T, 3): where the motion of each step ends; before the first one, where that does.

    `places_m` (B, T + 1, 3): of the tool, the last one at the episode's end. A motion ends where the next
    one of `motions` (B, T) begins, the last one, or all if there is none, at the episode's end.
    """
    n_steps = motions.shape[1]
    so_far = motions.cumsum(dim=1)
    # Of each step, the number of the motion that ends its own: the second one, for all before that.
    wanted = so_far.clamp(min=1) + 1
    # The first step at which so many have begun; one beyond the steps, where there are not so many.
    ends = torch.searchsorted(so_far.contiguous(), wanted.contiguous(), right=False)
    return places_m.gather(1, ends.clamp(max=n_steps)[..., None].expand(-1, -1, SPACE))


def _first(steps: Tensor, is_there: Tensor) -> Tensor:
    """Return (B, T): whether a frame is shown there, not for padding, and for the first time."""
    first = is_there.clone()
    first[:, 1:] &= steps[:, 1:] != steps[:, :-1]
    return first


def _shown(kept: Tensor, begins: Tensor, late_steps: int) -> tuple[Tensor, Tensor]:
    """Return (B, T) the steps that are shown, in order, and their weights; padding has none.

    A decision is shown up to `late_steps` times again with the weight of one: there is one frame of each.
    """
    times = kept.long()
    if late_steps:
        times = times + torch.randint(0, late_steps + 1, times.shape, device=times.device) * (kept & begins)
    ends = times.cumsum(dim=1)
    n_shown = ends[:, -1:]
    places = torch.arange(int(n_shown.max()), device=times.device).expand(len(times), -1)
    # Padding is the last step again, which does not count.
    steps = torch.searchsorted(ends, places.minimum(n_shown - 1).contiguous(), right=True)
    return steps, (places < n_shown) / times.gather(1, steps)


def _waiting_beyond(actions: Tensor, before: Tensor) -> Tensor:
    """Return chunks (B, T, chunk, action) that repeat the last action `before` a decision after it."""
    last = (before.sum(dim=-1, keepdim=True) - 1)[..., None].expand(-1, -1, 1, actions.shape[-1])
    return torch.where(before[..., None], actions, actions.gather(2, last))


def _kept(waits: Tensor, begins: Tensor, real: Tensor, config: EpisodeConfig) -> Tensor:
    """Return (B, T): the steps that are trained on, drawn by torch's generator."""
    if config.waits_evenly:
        left_out = waits & ~_evenly(waits, config.waiting_share)
    else:
        left_out = waits & (torch.rand(waits.shape, device=waits.device) > config.waiting_share)
    if config.moving_share < 1:
        begun = torch.zeros_like(real)
        begun[:, 1:] = real[:, :-1]  # all steps but the first one
        moves = begun & ~waits & ~begins
        left_out |= moves & (torch.rand(waits.shape, device=waits.device) > config.moving_share)
    left_out[:, -1] = False  # the frame that was sampled
    kept = real & ~left_out
    return kept & _until_a_decision(begins, config.decision_share) if config.decision_share else kept


def _evenly(among: Tensor, share: float) -> Tensor:
    """Return (B, T): of the steps `among` (B, T) one in each 1 / `share`, from a random one on."""
    offsets = torch.rand(len(among), 1, dtype=torch.float64, device=among.device)
    reached = (among.cumsum(dim=1) * share + offsets).floor()
    return among & (reached.diff(dim=1, prepend=torch.zeros_like(offsets)) > 0)


def _shares(config: EpisodeConfig, actions: Tensor) -> Tensor:
    """Return (chunk,): what the actions of a chunk count."""
    shares = torch.full((config.chunk_size,), 1.0, device=actions.device)
    if config.chunk_size > 1:
        shares = shares * (1 - config.first_action_weight) / (config.chunk_size - 1)
        shares[0] = config.first_action_weight
    return shares


def _augmented(images: Tensor, episodes: Tensor, config: EpisodeConfig, *, n_episodes: int) -> Tensor:
    """Return images (N, …) of these episodes (N,), changed alike in all frames of an episode."""
    if config.mix_colors:  # an order of the three colours of its own for each episode
        orders = torch.rand(n_episodes, 3, device=images.device).argsort(dim=1)[episodes]
        images = images.take_along_dim(orders[:, None, :, None, None], dim=-3)
    return _moved(images, episodes, n_episodes, config.shift_px) if config.shift_px else images


def goal_missed(goal_m: Tensor, right_m: Tensor, weights: Tensor) -> Tensor:
    """Return the squared error of goals (B, T, 3), weighted (B, T), in units of the last ones' variance."""
    missed = (goal_m - right_m).square().mean(dim=-1)
    return weighted_mean(missed, weights) / goal_variance(right_m[:, -1])


def goal_variance(right_m: Tensor) -> Tensor:
    """Return what the mean of goals (B, 3) misses, squared."""
    return (right_m - right_m.mean(dim=0)).square().mean().clamp(min=LEAST_VARIANCE_M2)


def _change(actions: Tensor, real: Tensor) -> Tensor:
    """Return (B, T): by how much an action differs at most from the one before; 1 for an episode's first."""
    change = torch.ones_like(actions[..., 0])
    difference = (actions[:, 1:] - actions[:, :-1]).abs().amax(dim=-1)
    change[:, 1:] = torch.where(real[:, :-1], difference, torch.ones_like(difference))
    return change.clamp(max=1.0)


def decisions(actions: Tensor) -> Tensor:
    """Return (T,): at which steps of an episode, (T, action), the arm begins to move after it waited."""
    real = torch.ones(1, len(actions), dtype=torch.bool)
    return _begins(_change(actions[None], real) < SAME_ACTION, real)[0]


def _begins(waits: Tensor, real: Tensor) -> Tensor:
    """Return (B, T): whether a step is a decision, one of motion after one of waiting."""
    begins = torch.zeros_like(waits)
    begins[:, 1:] = real[:, :-1] & waits[:, :-1] & ~waits[:, 1:]
    return begins


def _before_the_next(begins: Tensor, chunk_size: int) -> Tensor:
    """Return (B, T, chunk): whether no decision (B, T) lies between a step and that of the chunk's action."""
    so_far = begins.cumsum(dim=1)
    after = so_far[:, -1:].expand(-1, chunk_size - 1)
    return torch.cat([so_far, after], dim=1).unfold(1, chunk_size, 1) == so_far[..., None]


def _until_a_decision(begins: Tensor, share: float) -> Tensor:
    """Return (B, T): False after a decision, in the given share of the episodes that have one."""
    draws = torch.rand(begins.shape, device=begins.device).masked_fill(~begins, -1.0)
    last = draws.argmax(dim=1)
    ends = begins.any(dim=1) & (torch.rand(len(begins), device=begins.device) < share)
    steps = torch.arange(begins.shape[1], device=begins.device)
    return ~ends[:, None] | (steps <= last[:, None])


def _with_other_things(
    images: Tensor, n_frames: Tensor, n_before: Tensor, empty: Tensor, config: EpisodeConfig, may_stay: float
) -> Tensor:
    """Change the things in a share of the episodes, see `changed_things`.

    Of each of the B episodes, `n_frames` of the images (N, cameras, 3, H, W) are given, `n_before` of them
    before its first decision (0: there is none), and `empty` (B, cameras, 3, H, W), the frame before that.
    """
    exchanges, erases = (
        (torch.rand(len(n_frames)) < share).tolist() for share in (config.exchange_share, config.erase_share)
    )
    nothing = in_bytes(empty)
    parts = list(torch.split(in_bytes(images), n_frames.tolist()))
    for row in n_before.nonzero().flatten().tolist():
        if exchanges[row] or erases[row]:
            parts[row] = changed_things(
                parts[row],
                nothing[row],
                n_before=int(n_before[row]),
                erases=erases[row],
                exchanges=exchanges[row],
                may_stay=may_stay,
            )
    changed = torch.cat(parts)
    return changed if images.dtype == torch.uint8 else in_numbers(changed)


def _moved(images: Tensor, episodes: Tensor, n_episodes: int, most_px: int) -> Tensor:
    """Move what each camera saw of each episode; the edges are repeated."""
    moved = torch.empty_like(images)
    by = torch.randint(-most_px, most_px + 1, (n_episodes, images.shape[1], 2)).tolist()
    lengths = episodes.bincount(minlength=n_episodes).tolist()
    for seen, place, cameras in zip(
        torch.split(images, lengths), torch.split(moved, lengths), by, strict=True
    ):
        for camera, (down, right) in enumerate(cameras):
            place[:, camera] = _moved_along(_moved_along(seen[:, camera], down, dim=-2), right, dim=-1)
    return moved


def _moved_along(images: Tensor, px: int, *, dim: int) -> Tensor:
    """Move images by so many pixels; whole pieces are copied, which is much faster than pixels by number."""
    size = images.shape[dim]
    if px > 0:
        first = [images.narrow(dim, 0, 1)] * px
        return torch.cat([*first, images.narrow(dim, 0, size - px)], dim=dim)
    if px < 0:
        last = [images.narrow(dim, size - 1, 1)] * -px
        return torch.cat([images.narrow(dim, -px, size + px), *last], dim=dim)
    return images


def weighted_mean(values: Tensor, weights: Tensor) -> Tensor:
    """Return the mean of values with these weights, of the same shape; 0 if all weights are."""
    return (values * weights).sum() / weights.sum().clamp(min=LEAST_WEIGHT)
