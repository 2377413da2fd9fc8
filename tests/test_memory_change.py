"""A memory that is changed between two inferences, on a policy that writes down when it was asked."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import pytest

from vla_eval.core import ActionChunk, EpisodeStart, MemoryArrays, Observation, ObservationWindow
from vla_eval.errors import RecipeError, SpecMismatchError
from vla_eval.memory_change import ChangedMemory, MemoryChange, memory_parts, noisy, parts_of
from vla_eval.specs import PolicySpec

K = 4
LEVEL = np.array([0.0, 1.0, 2.0, 3.0], np.float32)


class Diary:
    """A policy that remembers at which steps it was asked, and a level that nothing changes."""

    def __init__(self, *, has_memory: bool = True) -> None:
        self.spec = PolicySpec(
            name="diary", reads="last", cameras=(), states=(), chunk_size=K, has_memory=has_memory
        )
        self.memories: dict[int, dict[str, Any]] = {}
        self.read: list[tuple[int, tuple[int, ...]]] = []  # step, and what was remembered then

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        for episode in episodes:
            self.memories[episode.slot] = {"diary/level": LEVEL.copy()}

    def act(self, window: ObservationWindow) -> ActionChunk:
        memory, step = self.memories[window.slot], window.last.step
        steps = memory.get("log/steps", np.zeros(0, np.int64))
        self.read.append((step, tuple(int(one) for one in steps)))
        memory["log/steps"] = np.append(steps, step)
        value = float(steps.sum() + 100 * memory["diary/level"].sum())
        return ActionChunk(actions=np.full((K, 1), value, np.float32))

    def get_memory(self, slot: int) -> MemoryArrays:
        return {name: array.copy() for name, array in self.memories[slot].items()}

    def set_memory(self, slot: int, memory: MemoryArrays) -> None:
        self.memories[slot] = {name: array.copy() for name, array in memory.items()}


def start(slot: int = 0, seed: int = 1) -> EpisodeStart:
    return EpisodeStart(slot=slot, task="T", seed=seed, run=0, instruction="", horizon_steps=60)


def window(step: int, slot: int = 0) -> ObservationWindow:
    return ObservationWindow(slot=slot, frames=(Observation(step=step, images={}, state={}),))


def run(
    change: MemoryChange, *, until: int = 24, donors: Mapping[int, MemoryArrays] | None = None
) -> tuple[Diary, list[float]]:
    """Return the policy after the inferences at 0, 4, 8 … and what it answered."""
    policy = Diary()
    changed = ChangedMemory(policy, change, donors)
    changed.reset([start()])
    answers = [float(changed.act(window(step)).actions[0, 0]) for step in range(0, until, K)]
    return policy, answers


def test_a_held_memory_is_that_of_the_first_inference_at_or_after_the_step() -> None:
    policy, _ = run(MemoryChange(kind="hold_memory", at_step=6))
    before, held = [(0, ()), (4, (0,))], (0, 4)
    assert policy.read == [*before, (8, held), (12, held), (16, held), (20, held)]


@pytest.mark.parametrize(("age_steps", "lag"), [(1, 1), (4, 1), (5, 2), (8, 2), (100, 99)])
def test_a_stale_memory_is_the_newest_that_is_old_enough_and_its_own_course_is_as_before(
    age_steps: int, lag: int
) -> None:
    policy, answers = run(MemoryChange(kind="stale_memory", age_steps=age_steps))
    steps = list(range(0, 24, K))
    # Before the inference at t, what was kept of all before it; here, of all before the one `lag` earlier.
    expected = [sum(steps[: max(0, index - lag)]) + 600 for index in range(len(steps))]
    assert answers == expected
    assert policy.memories[0]["log/steps"].tolist() == steps


def test_a_memory_is_stale_from_its_step_on() -> None:
    _, answers = run(MemoryChange(kind="stale_memory", age_steps=8, at_step=12))
    # Kept before the inferences at 0, 4, 8: no step; 0; 0 and 4. From 12 on that of 4, 8 and 12.
    assert answers == [600, 600, 604, 600, 604, 612]


def test_a_donor_s_memory_is_put_in_once() -> None:
    donor = {"diary/level": 2 * LEVEL, "log/steps": np.array([7, 7])}
    policy, answers = run(
        MemoryChange(kind="transplant", donor_env={"swap_cue": 1}, at_step=8), donors={0: donor}
    )
    assert policy.read == [(0, ()), (4, (0,)), (8, (7, 7)), (12, (7, 7, 8)), (16, (7, 7, 8, 12)),
                           (20, (7, 7, 8, 12, 16))]  # fmt: skip
    assert answers[:3] == [600, 600, 1214]


def test_what_was_left_behind_is_there_from_the_first_inference_on() -> None:
    policy, _ = run(
        MemoryChange(kind="carry_over"),
        until=8,
        donors={0: {"diary/level": LEVEL, "log/steps": np.array([9])}},
    )
    assert policy.read == [(0, (9,)), (4, (9, 0))]


class TestErase:
    @pytest.mark.parametrize(("part", "remembered"), [("log", ()), ("diary/level", (0, 4))])
    def test_a_part_is_as_an_episode_begins_and_the_others_stay(
        self, part: str, remembered: tuple[int, ...]
    ) -> None:
        policy, _ = run(MemoryChange(kind="erase_memory", part=part, at_step=8), until=12)
        assert policy.read[-1] == (8, remembered)

    def test_a_part_that_is_not_there_is_refused_with_those_that_are(self) -> None:
        with pytest.raises(SpecMismatchError, match=r"expected one of diary/level, log, found 'logs'"):
            run(MemoryChange(kind="erase_memory", part="logs", at_step=8))

    def test_parts_are_arrays_an_episode_begins_with_and_groups_of_the_others(self) -> None:
        policy = Diary()
        policy.reset([start()])
        policy.act(window(0))
        assert memory_parts(policy, start()) == ("diary/level", "log")
        assert memory_parts(Diary(has_memory=False), start()) == ()

    def test_an_array_that_grows_is_part_of_its_group(self) -> None:
        begun = {"a/x": np.zeros(2), "b/y": np.zeros((0, 3))}
        later = {"a/x": np.ones(2), "b/y": np.ones((4, 3)), "b/z": np.ones(1)}
        assert parts_of(begun, later) == ("a/x", "b")


class TestNoise:
    MEMORY: ClassVar[MemoryArrays] = {
        "a": np.arange(20_000, dtype=np.float32),
        "b": np.array([1.0, np.inf, -np.inf, np.nan, 3.0]),
        "steps": np.arange(5),
        "mask": np.array([True, False]),
        "empty": np.zeros((0, 3), np.float32),
        "same": np.full(7, 2.0, np.float16),
    }

    def test_none_changes_no_bit(self) -> None:
        for name, array in noisy(self.MEMORY, dose=0.0, seed=3).items():
            assert array.dtype == self.MEMORY[name].dtype
            assert array.tobytes() == self.MEMORY[name].tobytes()

    def test_it_is_that_many_deviations_and_leaves_counters_masks_and_infinities(self) -> None:
        noised = noisy(self.MEMORY, dose=0.5, seed=3)
        added = noised["a"].astype(np.float64) - self.MEMORY["a"]
        deviation = 20_000 / np.sqrt(12)
        assert added.std() == pytest.approx(0.5 * deviation, rel=0.03)
        assert abs(added.mean()) < 4 * 0.5 * deviation / np.sqrt(20_000)
        for name in ("steps", "mask", "empty", "same"):
            assert noised[name].tobytes() == self.MEMORY[name].tobytes()
        assert noised["b"][1:4].tobytes() == self.MEMORY["b"][1:4].tobytes()
        assert (noised["b"][[0, 4]] != self.MEMORY["b"][[0, 4]]).all()
        assert self.MEMORY["b"][0] == 1.0  # a copy was made

    def test_it_depends_on_the_seed_and_the_name_and_on_no_other_array(self) -> None:
        one, again = noisy(self.MEMORY, dose=1.0, seed=3), noisy({"a": self.MEMORY["a"]}, dose=1.0, seed=3)
        assert one["a"].tobytes() == again["a"].tobytes()
        assert one["a"].tobytes() != noisy(self.MEMORY, dose=1.0, seed=4)["a"].tobytes()
        twin = noisy({"a": self.MEMORY["a"], "z": self.MEMORY["a"]}, dose=1.0, seed=3)
        assert abs(np.corrcoef(twin["a"] - self.MEMORY["a"], twin["z"] - self.MEMORY["a"])[0, 1]) < 0.05

    def test_it_comes_once(self) -> None:
        policy, answers = run(MemoryChange(kind="memory_noise", dose=1.0, at_step=8))
        levels = [answer - sum(steps) for answer, (_, steps) in zip(answers, policy.read, strict=True)]
        assert levels[:2] == [600, 600]
        assert levels[2] != pytest.approx(600)
        assert levels[2:] == pytest.approx([levels[2]] * 4)


@pytest.mark.parametrize("kind", ["hold_memory", "stale_memory", "memory_noise"])
def test_episodes_side_by_side_are_those_of_alone(kind: str) -> None:
    extra = {"stale_memory": {"age_steps": 5}, "memory_noise": {"dose": 1.0}}.get(kind, {})
    change = MemoryChange(kind=kind, at_step=6, **extra)  # type: ignore[arg-type]
    _, alone = run(change, until=16)
    both = ChangedMemory(Diary(), change)
    both.reset([start(slot=1, seed=9), start()])
    for index, step in enumerate(range(0, 16, K)):
        windows = [window(step, slot=1), window(step)] if step != 4 else [window(step)]
        assert float(both.act_batch(windows)[-1].actions[0, 0]) == alone[index]


def test_the_next_episode_is_changed_as_the_first_was() -> None:
    change = MemoryChange(kind="hold_memory", at_step=4)
    policy = Diary()
    changed = ChangedMemory(policy, change)
    for _ in range(2):
        policy.read.clear()
        changed.reset([start()])
        for step in (0, 4, 8):
            changed.act(window(step))
        assert policy.read == [(0, ()), (4, (0,)), (8, (0,))]


def test_a_policy_without_memory_is_refused() -> None:
    forgetful = Diary(has_memory=False)
    with pytest.raises(SpecMismatchError, match="policy 'diary' keeps nothing between two inferences"):
        ChangedMemory(forgetful, MemoryChange(kind="hold_memory"))


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"kind": "transplant"}, "memory_change.donor_env: expected a value for kind=transplant, found None"),
        ({"kind": "transplant", "donor_env": {}}, "donor_env: expected a value"),
        ({"kind": "memory_noise"}, "memory_change.dose: expected a value"),
        ({"kind": "memory_noise", "dose": -1.0}, "memory_change.dose"),
        ({"kind": "memory_noise", "dose": 1.0, "part": "a"}, "memory_change.part: expected none"),
        ({"kind": "stale_memory"}, "memory_change.age_steps: expected a value"),
        ({"kind": "stale_memory", "age_steps": 0}, "memory_change.age_steps"),
        ({"kind": "erase_memory"}, "memory_change.part: expected a value"),
        ({"kind": "erase_memory", "part": ""}, "memory_change.part: expected a value"),
        ({"kind": "hold_memory", "dose": 0.0}, "memory_change.dose: expected none"),
        ({"kind": "hold_memory", "at_step": -1}, "memory_change.at_step"),
        ({"kind": "carry_over", "at_step": 3}, "memory_change.at_step: expected 0 for kind=carry_over"),
    ],
)
def test_a_change_that_says_too_little_or_too_much_is_refused(fields: dict[str, Any], says: str) -> None:
    with pytest.raises(RecipeError, match=says):
        MemoryChange(**fields)
