"""BunchOfColors, SeqOfColors, ChainOfColors: several cubes are shown, and all of them must be found again.

They differ in how the cubes are shown (together, or one after another) and whether the order counts.
"""

from typing import Any

import numpy as np
import sapien
from numpy.typing import NDArray

from vla_eval.seeding import Stream
from vla_eval.tasks.item_choice import ItemChoiceEnv
from vla_eval.tasks.memory_env import Place, nearness
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import Flags, Indices, Steps, anywhere
from vla_eval.tasks.objects.free_places import Area, used_areas
from vla_eval.tasks.objects.items import COLORS, CUBE_HALF_SIZE_M, Item, cube
from vla_eval.tasks.objects.layout import bunch_place_m
from vla_eval.tasks.objects.limits import (
    CubeHalfSize,
    ItemCount,
    NotNegative,
    Positive,
    ShownCount,
    SomeSteps,
    StepCount,
)
from vla_eval.tasks.spec import chance_of_several, total_cue_steps
from vla_eval.tasks.tensors_out import Info

TOUCH_ABOVE_TOP_M = 0.005  # the point to touch: official 2.5 cm over the centre of a cube of 4 cm
TOUCH_RADIUS_M = 0.02
FOUND_REWARD = 90.0
MISTAKE_REWARD = -10.0

Order = NDArray[np.int64]
"""(L,) the cubes that are shown, in their order."""


class SeveralColorsEnv(ItemChoiceEnv):
    """Find all cubes that were shown before, and no other.

    Description: some of N cubes lie on the table, together or one after another (cue), then the table is
    empty (delay), then all N lie on an arc in random order (response).

    A cube is touched when, in the response phase, the tool centre point is within `goal_threshold_m` of
    the point half a centimetre over the cube's top, with the arm at rest, for `dwell_steps` steps. All
    that were shown must be touched, in the order shown if the family requires it. After the first touch of a
    wrong cube, or out of order, the episode can no longer succeed; touching a cube again changes nothing.

    Observation space: `state` adds the vector to the next cube 3, sequence L, and per cube: position 3,
    touched 1, right 1, next 1.

    Rewards: dense, from the response phase on: reach the next cube 1 + slow down 0.5 + 90 per share found
    - 10 per mistake, or 100 if solved; see `docs/tasks.md`.

    Starting state: arm at rest with joint noise of 0.02 rad; colours shown and places drawn uniformly.

    Episode end: 120 control steps; success and failure are reported but end nothing by themselves.

    Arguments: `n_items` 2 to 9 cubes, `n_shown` 1 to `n_items`, `cue_steps` (for each cube, or for all
    together), `gap_steps` of empty table between two of them, `dwell_steps`, `cube_half_size_m`, and
    those of `ChoiceEnv` and `MemoryTableEnv`. `swap_cue` shows another cube instead of the first one;
    `swap_order` k exchanges the first cube and the one k later, if they are shown one after another (the
    right answer changes only if the order counts). `shuffle_cue` shows the drawn cubes in another order,
    drawn per episode, and leaves the right answer as it is. `strict_choice` ends the episode at the first
    mistake.

    Chance level: for L of N, 1 / C(N, L); in order, 1 / (N (N - 1) … (N - L + 1)).

    Version history: 1, first version.
    """

    MAX_REWARD = 100.0
    REACH_SCALE_PER_M = 10.0
    SLOWING_WEIGHT = 0.5
    ONE_BY_ONE: bool
    """Whether the cubes are shown one after another at the same place."""

    def __init__(
        self,
        *args: Any,
        n_items: ItemCount = 9,
        n_shown: ShownCount = 3,
        gap_steps: StepCount = 0,
        dwell_steps: SomeSteps = 1,
        swap_order: NotNegative = 0,
        shuffle_cue: bool = False,
        goal_threshold_m: Positive = TOUCH_RADIUS_M,
        cube_half_size_m: CubeHalfSize = CUBE_HALF_SIZE_M,
        phase_gate_success: bool = True,
        **kwargs: Any,
    ) -> None:
        limits.check(ItemCount, n_items=n_items)
        limits.check(ShownCount, n_shown=n_shown)
        limits.check(StepCount, gap_steps=gap_steps)
        limits.check(SomeSteps, dwell_steps=dwell_steps)
        limits.check(NotNegative, swap_order=swap_order)
        limits.check_together(
            n_items=n_items,
            n_shown=n_shown,
            gap_steps=gap_steps,
            swap_order=swap_order,
            shuffle_cue=shuffle_cue,
            phase_gate_success=phase_gate_success,
            one_by_one=self.ONE_BY_ONE,
        )
        self.n_shown, self.gap_steps, self.dwell_steps = n_shown, gap_steps, dwell_steps
        self.swap_order, self.shuffle_cue = swap_order, shuffle_cue
        self.touch_height_m = cube_half_size_m + TOUCH_ABOVE_TOP_M
        shape = cube(cube_half_size_m)
        items = tuple(Item(shape, color) for color in COLORS[:n_items])
        super().__init__(*args, items=items, goal_threshold_m=goal_threshold_m, **kwargs)

    def stream_key(self) -> tuple[int, ...]:
        """Return the family's number, how many cubes there are and how many are shown."""
        return (self.FAMILY, self.n_items, self.n_shown)

    def total_cue_steps(self, cue_steps: int) -> int:
        """Return the length of the cue phase if each cube is shown for `cue_steps`."""
        of_all = total_cue_steps(cue_steps, self.n_shown if self.ONE_BY_ONE else 1, self.gap_steps)
        return super().total_cue_steps(of_all)

    def chance_success(self) -> float:
        """Return the success rate of a perfect arm that knows how many cubes were shown, not which."""
        return chance_of_several(self.n_items, self.n_shown, in_order=self.in_order)

    def _load_scene(self, options: dict[str, Any]) -> None:
        super()._load_scene(options)
        self._sequence: Indices = np.zeros((self.num_envs, self.n_shown), dtype=np.int64)
        self._drawn_sequence = np.zeros_like(self._sequence)
        self._seen_sequence = np.zeros_like(self._sequence)
        self._is_shown: Flags = np.zeros_like(self._touch_rank, dtype=np.bool_)
        self._is_drawn = np.zeros_like(self._is_shown)
        self._near = np.full_like(self._target, -1)
        self._near_steps = np.zeros_like(self._target)

    def _sample_episode(self, env: int) -> None:
        drawn = self.episode_generator(env, Stream.TARGET).permutation(self.n_items)
        shown = drawn[: self.n_shown].copy()
        if self.swap_cue:
            shown[0] = drawn[self.n_shown + self.swap_cue - 1]
        shown[[0, self.swap_order]] = shown[[self.swap_order, 0]]
        self._drawn_sequence[env] = drawn[: self.n_shown]
        self._sequence[env] = shown
        self._seen_sequence[env] = self._shuffled(env, shown) if self.shuffle_cue else shown
        for flags, sequence in ((self._is_drawn, self._drawn_sequence), (self._is_shown, self._sequence)):
            flags[env] = False
            flags[env, sequence[env]] = True
        self._sample_slots(env)
        self._sample_distractor(env, {int(index) for index in (*drawn[: self.n_shown], *shown)})

    def _shuffled(self, env: int, shown: Order) -> Order:
        """Return the cubes in another order than they have; each of the others is as probable."""
        rng = self.episode_generator(env, Stream.SHUFFLE)
        shuffled = shown
        while np.array_equal(shuffled, shown):
            shuffled = rng.permutation(shown)
        return shuffled

    def is_swapped(self) -> bool:
        """Return whether other cubes than the drawn ones are seen, or in another order."""
        return super().is_swapped() or self.swap_order > 0 or self.shuffle_cue

    def n_swaps(self) -> int:
        """Return how many cubes that are not shown could be shown instead of the first one."""
        return limits.n_swaps(n_items=self.n_items, n_shown=self.n_shown)

    def _on_episode_start(self, mask: Flags) -> None:
        super()._on_episode_start(mask)
        self._near_steps[mask] = 0

    def _on_phase_edges(self, step: Steps, mask: Flags) -> bool:
        if not anywhere(step <= self._response_step):  # most steps of an episode
            return False
        in_cue = mask & (step < self._cue_end_step) & self.show_cue
        cue_ends = mask & (step == self._cue_end_step) & (step > 0)
        choice_begins = mask & (step == self._response_step)
        if self.ONE_BY_ONE:
            moved = self._show_in_turn(step, in_cue)
        else:
            moved = in_cue & (step == self.cue_after_steps)
            self._show_together(moved)
        self._park_all(cue_ends)
        distracts = self._distract(step, mask)
        self._reveal_all(choice_begins)
        return anywhere(moved | cue_ends | distracts | choice_begins)

    def used_areas(self) -> tuple[Area, ...]:
        """Return where cubes can lie and be shown, with the hand over them."""
        return used_areas(n_items=self.n_items, n_shown=self.n_shown, goal_threshold_m=self.goal_threshold_m)

    def cue_places_m(self, env: int) -> list[Place]:
        """Return where cubes are shown: in turn at the same place, or each at its own."""
        if self.ONE_BY_ONE:
            return super().cue_places_m(env)
        return [(*bunch_place_m(index, self.n_items), 0.0) for index in self.right_candidates(env)]

    def _show_together(self, mask: Flags) -> None:
        if not anywhere(mask):
            return
        for index, item in enumerate(self.items):
            x, y = bunch_place_m(index, self.n_items)
            place = sapien.Pose(p=[x, y, item.shape.rest_height_m])
            moved, seen = mask & self._is_drawn[:, index], mask & self._is_shown[:, index]
            self._show_item(index, place, moved=moved, seen=seen)

    def _show_in_turn(self, step: Steps, mask: Flags) -> Flags:
        """Show or hide the cube whose turn begins or ends at `step`; return (B,) where anything moved."""
        step = step - self.cue_after_steps
        mask = mask & (step >= 0)
        turn_steps = self._turn_steps()
        turn = (step // np.maximum(turn_steps, 1)).clip(0, self.n_shown - 1)
        since = step - turn * turn_steps
        begins = mask & (since == 0)
        ends = mask & (since == turn_steps - self.gap_steps)
        self._park_all((begins & (step > 0)) | ends)
        drawn, seen = (order[self._rows, turn] for order in (self._drawn_sequence, self._seen_sequence))
        self._show_in_middle(begins, drawn, seen)
        either: Flags = begins | ends
        return either

    def _turn_steps(self) -> Steps:
        """Return (B,) the steps from one cube to the next: `total_cue_steps` solved for them."""
        cue_steps = self._cue_end_step - self.cue_after_steps
        return (cue_steps + self.gap_steps) // self.n_shown

    def shown_candidates(self, env: int) -> tuple[int, ...]:
        """Return the right candidates whose cue is in view now: one at most if they are shown in turn."""
        shown = super().shown_candidates(env)
        if not shown or not self.ONE_BY_ONE:
            return shown
        turn_steps = int(self._turn_steps()[env])
        turn, since = divmod(int(self.step_count()[env]) - self.cue_after_steps, turn_steps)
        return (int(self._seen_sequence[env, turn]),) if since < turn_steps - self.gap_steps else ()

    def right_candidates(self, env: int) -> tuple[int, ...]:
        """Return the cubes that were shown, in the order shown."""
        return tuple(int(i) for i in self._sequence[env])

    def _n_found(self) -> Indices:
        n_found: Indices = ((self._touch_rank > 0) & ~self._touched_wrongly).sum(axis=1)
        return n_found

    def target_index(self) -> Indices:
        """Return (B,) the cube to touch next; if any order is allowed, the first by colour (official)."""
        if self.in_order:
            following: Indices = self._sequence[self._rows, np.minimum(self._n_found(), self.n_shown - 1)]
            return following
        left = self._is_shown & (self._touch_rank == 0)
        return np.where(left.any(axis=1), left.argmax(axis=1), self._sequence[:, -1])

    def _is_wrong(self, candidate: Indices) -> Flags:
        if self.in_order:
            wrong: Flags = (candidate != self.target_index()) | (self._n_found() == self.n_shown)
        else:
            wrong = ~self._is_shown[self._rows, candidate]
        return wrong

    def _latch_touch(self, touches: Flags, candidate: Indices) -> None:
        same = touches & (self._near_steps > 0) & (candidate == self._near)
        self._near_steps = np.where(same, self._near_steps + 1, touches)
        self._near = candidate
        super()._latch_touch(touches & (self._near_steps >= self.dwell_steps), candidate)

    def evaluate(self) -> Info:
        """Read success, failure and choices; changes nothing."""
        info, n_found = super().evaluate(), self._n_found()
        solved = (n_found == self.n_shown) & (info["n_wrong_choices"] == 0)
        return {**info, "success": self.gated(solved & info["is_robot_static"]), "n_found": n_found}

    def oracle_info(self) -> NDArray[np.uint8]:
        """Return (B, L): the cubes that were shown, in the order shown."""
        return self._sequence.astype(np.uint8)

    def reward_terms(self, info: Info) -> Info:
        """Reach the next cube, slow down, find cubes, make no mistake; nothing before the response phase."""
        begun = self.response_begun()
        return {
            "reaching": nearness(self.REACH_SCALE_PER_M, info["target_distance_m"]) * begun,
            "slowing": self.SLOWING_WEIGHT * nearness(5.0, self.arm_speed()) * begun,
            "found": FOUND_REWARD * info["n_found"] / self.n_shown,
            "mistakes": MISTAKE_REWARD * info["n_wrong_choices"],
        }

    def _privileged_extra(self) -> Info:
        positions = self.candidate_positions_m()
        following = self.target_index()
        extra: Info = {
            "obj_to_goal_pos": self.target_point_m() - self.tcp_position_m(),
            "oracle_info": self.oracle_info(),
        }
        for index in range(self.n_items):
            extra[f"cube_{index}_pose"] = positions[:, index]
            extra[f"cube_{index}_touched"] = self._touch_rank[:, index, None] > 0
            extra[f"cube_{index}_is_right"] = self._is_shown[:, index, None]
            extra[f"cube_{index}_is_next"] = (following == index)[:, None]
        return extra


class BunchOfColorsEnv(SeveralColorsEnv):
    """BunchOfColors: touch the cubes that were shown together, in any order; see `SeveralColorsEnv`."""

    FAMILY = 6
    ONE_BY_ONE = False


class SeqOfColorsEnv(SeveralColorsEnv):
    """SeqOfColors: touch the cubes that were shown one by one, in any order; see `SeveralColorsEnv`."""

    FAMILY = 7
    ONE_BY_ONE = True


class ChainOfColorsEnv(SeveralColorsEnv):
    """ChainOfColors: touch the cubes that were shown one by one, in that order; see `SeveralColorsEnv`."""

    FAMILY = 8
    ONE_BY_ONE = True
    in_order = True
