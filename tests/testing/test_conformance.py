"""The kit in `vla_eval.testing`: ours pass it, and it notices each kind of broken promise."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.core import ActionChunk, EpisodeStart, FloatArray, ImageArray, ObservationWindow, StepResult
from vla_eval.envs.factory import make_env
from vla_eval.errors import ConformanceError
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_hold, make_random
from vla_eval.specs import EnvSpec, PolicySpec
from vla_eval.testing import check_env, check_policy, check_task

FAKE = EnvSettings(task="RememberColor3-v0", simulator="fake", cameras=("base_camera", "hand_camera"))


@pytest.mark.sampled(7)
@pytest.mark.parametrize("n_episodes", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_our_tasks_pass(sampled_task: str, n_episodes: int) -> None:
    check_task(sampled_task, n_episodes=n_episodes)


def test_the_fake_environment_passes() -> None:
    check_env(lambda: make_env(FAKE))


@pytest.mark.parametrize("make", [make_random, make_hold])
def test_our_policies_pass(make: Any) -> None:
    env: Any = make_env(FAKE)
    chunking = ChunkingSpec(n_action_steps=4)
    context = PolicyContext(name="p", env=env.spec, chunking=chunking, n_candidates=3)
    check_policy(lambda: make(context), env.spec)


class BrokenEnv:
    """The fake environment with one promise broken."""

    def __init__(self, fault: str) -> None:
        self._env: Any = make_env(FAKE)
        self.spec = self._env.spec
        self.fault = fault
        self._n_resets = 0
        self._buffer = np.zeros(9, dtype=np.float32)

    def _break(self, result: StepResult) -> StepResult:
        state = dict(result.observation.state)
        images = dict(result.observation.images)
        if self.fault == "past":
            state["qpos"] = state["qpos"] + np.float32(1e-6 * self._n_resets)
        elif self.fault == "buffer":
            self._buffer[:] = state["qpos"]
            state["qpos"] = self._buffer
        elif self.fault == "camera" and images:
            images["hand_camera"] = images["hand_camera"][:64]
        return replace(result, observation=replace(result.observation, state=state, images=images))

    def reset(self, seeds: Any, *, render: bool) -> dict[int, StepResult]:
        self._n_resets += 1
        used = {slot: 1 for slot in seeds} if self.fault == "seed" else seeds
        return {k: self._break(r) for k, r in self._env.reset(used, render=render).items()}

    def step(self, actions: Any, *, render: frozenset[int]) -> dict[int, StepResult]:
        return {k: self._break(r) for k, r in self._env.step(actions, render=render).items()}

    def hold_action(self, slot: int) -> FloatArray:
        action: FloatArray = self._env.hold_action(slot)
        return action

    def close(self) -> None:
        self._env.close()


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("past", "bit-equal episodes in a used environment"),
        ("buffer", "must not share a buffer"),
        ("camera", "Camera 'hand_camera' gives uint8"),
        ("seed", "Different seeds must give different episodes"),
    ],
)
def test_a_broken_environment_is_noticed(fault: str, sentence: str) -> None:
    with pytest.raises(ConformanceError, match=sentence):
        check_env(lambda: BrokenEnv(fault))


class BrokenPolicy:
    """A policy that sums up what it sees, with one promise broken."""

    def __init__(self, fault: str) -> None:
        self.spec = PolicySpec(name="broken", reads="last", cameras=(), states=("qpos",), chunk_size=2)
        self.fault = fault
        self._rng = np.random.default_rng(0)
        self._buffer = np.zeros((2, 7), dtype=np.float32)
        self._sums: dict[int, float] = {}

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        if self.fault == "others":
            self._sums.clear()
        for episode in episodes:
            if self.fault != "kept" or episode.slot not in self._sums:
                self._sums[self._key(episode.slot)] = 0.0

    def _key(self, slot: int) -> int:
        return 0 if self.fault == "mixed" else slot

    def act(self, window: ObservationWindow) -> ActionChunk:
        key = self._key(window.slot)
        self._sums[key] = self._sums.get(key, 0.0) + float(window.last.state["qpos"].sum())
        if self.fault == "writes":
            window.last.state["qpos"][:] = 0
        if self.fault == "buffer":
            return ActionChunk(actions=self._buffer)
        if self.fault == "past":
            return ActionChunk(actions=self._rng.uniform(-1, 1, (2, 7)).astype(np.float32))
        return ActionChunk(actions=np.full((2, 7), self._sums[key], dtype=np.float32))


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("past", r"the same actions after another episode\. Forget everything of a slot"),
        ("kept", r"the same actions after another episode\. Forget everything of a slot"),
        ("mixed", r"beside another episode\. Keep your state by `window\.slot`"),
        ("others", r"when another episode begins .* Keep your state by `window\.slot`"),
        ("writes", "leaves the observations as they are"),
        ("buffer", "must not share a buffer"),
    ],
)
def test_a_broken_policy_is_noticed(fault: str, sentence: str) -> None:
    env: Any = make_env(FAKE)
    with pytest.raises(ConformanceError, match=sentence):
        check_policy(lambda: BrokenPolicy(fault), env.spec)


def test_a_policy_with_memory_by_slot_passes_and_the_check_says_what_it_tried() -> None:
    env: Any = make_env(FAKE)
    said: list[str] = []
    met = check_policy(lambda: BrokenPolicy("none"), env.spec, report=said.append)
    assert met == said
    assert "The same episode seed and observations give the same actions beside another episode." in met
    assert "A chunk is float32 of shape (2, 7) and finite." in met


class NotANumberLater:
    """Gives NaN in row 1, dimension `dz`, of its second chunk."""

    def __init__(self) -> None:
        self.spec = BrokenPolicy("none").spec
        self._n_chunks = 0

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        self._n_chunks = 0

    def act(self, window: ObservationWindow) -> ActionChunk:
        actions = np.zeros((2, 7), dtype=np.float32)
        if self._n_chunks == 1:
            actions[1, 2] = np.nan
        self._n_chunks += 1
        return ActionChunk(actions=actions)


def test_a_number_that_is_not_finite_is_named_by_row_dimension_and_step() -> None:
    env: Any = make_env(FAKE)
    # Chunks of two actions: the second one begins at step 2. The first episode of the check has seed 0.
    with pytest.raises(
        ConformanceError, match=r"nan in row 1, dimension 'dz', of the chunk at step 2 \(seed 0\)"
    ):
        check_policy(NotANumberLater, env.spec)


def _patch_is_right(image: ImageArray) -> bool:
    brightness = image.mean(axis=(0, 2))
    half = len(brightness) // 2
    return bool(brightness[:half].mean() < brightness[half:].mean())


def _small_env() -> EnvSpec:
    """Return a specification with small images, which are quick to make."""
    spec: EnvSpec = make_env(FAKE).spec
    return replace(spec, cameras=tuple(replace(one, height_px=16, width_px=16) for one in spec.cameras))


# What is left of an observation is one bit: a policy that compares two things, or counts cubes of a colour.
BITS: dict[str, Callable[[ImageArray, FloatArray, str], bool]] = {
    "more red than green": lambda image, _state, _sentence: image[..., 0].mean() > image[..., 1].mean(),
    "more green than blue": lambda image, _state, _sentence: image[..., 1].mean() > image[..., 2].mean(),
    "bright": lambda image, _state, _sentence: image.mean() > 105,
    "a place": lambda image, _state, _sentence: _patch_is_right(image),
    "a colour at a place": lambda image, _state, _sentence: (
        (image[..., 0].mean() > image[..., 1].mean()) != _patch_is_right(image)
    ),
    "the sign of one joint": lambda _image, state, _sentence: state[0] > 0,
    "the sign of the next": lambda _image, state, _sentence: state[1] > 0,
    "the sentence": lambda _image, _state, sentence: "red" in sentence,
}
MEMORIES: dict[str, Callable[[list[bool]], bool]] = {
    "the first": lambda seen: seen[0],
    "the one before": lambda seen: seen[-2] if len(seen) > 1 else False,
    "the majority": lambda seen: sum(seen) * 2 > len(seen),
    "how often": lambda seen: sum(seen) % 2 == 1,
    "the tenth": lambda seen: seen[9] if len(seen) > 9 else False,
}


class OneBit:
    """Acts on one remembered bit; the memory is of the slot, or one for all slots."""

    def __init__(self, bit: str, memory: str, *, is_shared: bool, chunk_size: int = 1) -> None:
        self.spec = PolicySpec(
            name="bit", reads="last", cameras=("base_camera",), states=("qpos",), chunk_size=chunk_size
        )
        self._bit, self._memory, self._is_shared = BITS[bit], MEMORIES[memory], is_shared
        self._seen: dict[int, list[bool]] = {}
        self._sentences: dict[int, str] = {}

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        for episode in episodes:
            self._seen[self._place(episode.slot)] = []
            self._sentences[self._place(episode.slot)] = episode.instruction

    def _place(self, slot: int) -> int:
        return 0 if self._is_shared else slot

    def act(self, window: ObservationWindow) -> ActionChunk:
        seen = self._seen[self._place(window.slot)]
        image, state = window.last.images["base_camera"], window.last.state["qpos"]
        seen.append(bool(self._bit(image, state, self._sentences[self._place(window.slot)])))
        value = float(self._memory(seen))
        return ActionChunk(actions=np.full((self.spec.chunk_size, 7), value, dtype=np.float32))


@pytest.mark.sampled(8)
@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("bit", BITS)
def test_one_memory_for_all_slots_is_noticed_whatever_is_left_of_an_observation(
    bit: str, memory: str
) -> None:
    env = _small_env()
    check_policy(lambda: OneBit(bit, memory, is_shared=False), env)
    with pytest.raises(ConformanceError, match=r"Keep your state by `window\.slot`"):
        check_policy(lambda: OneBit(bit, memory, is_shared=True), env)


@pytest.mark.parametrize("chunk_size", [4, 8])
@pytest.mark.parametrize("memory", ["the first", "the one before", "how often"])
@pytest.mark.parametrize("bit", BITS)
def test_it_is_noticed_in_longer_chunks(bit: str, memory: str, chunk_size: int) -> None:
    env = _small_env()
    with pytest.raises(ConformanceError, match=r"Keep your state by `window\.slot`"):
        check_policy(lambda: OneBit(bit, memory, is_shared=True, chunk_size=chunk_size), env)


def test_a_policy_that_knows_one_sentence_is_checked_with_it_and_that_is_said() -> None:
    class KnowsOne(OneBit):
        def reset(self, episodes: Sequence[EpisodeStart]) -> None:
            for episode in episodes:
                {"pick up the red cube": 0}[episode.instruction]
            super().reset(episodes)

    env = _small_env()
    met = check_policy(lambda: KnowsOne("bright", "the first", is_shared=False), env)
    assert any(line.startswith("Not tried: episodes with different sentences") for line in met)
    with pytest.raises(ConformanceError, match="Keep your state"):
        check_policy(lambda: KnowsOne("bright", "the first", is_shared=True), env)


class Raising(OneBit):
    """Raises an exception in its second inference."""

    def act(self, window: ObservationWindow) -> ActionChunk:
        if len(self._seen[window.slot]) == 1:
            raise KeyError("camera")
        return super().act(window)


def test_an_exception_of_the_policy_is_one_message_with_line_step_and_seed() -> None:
    pattern = r"`act` raised KeyError: 'camera' \(test_conformance.py, line \d+\), at step 4 of seed 0\."
    with pytest.raises(ConformanceError, match=pattern):
        check_policy(lambda: Raising("bright", "the first", is_shared=False, chunk_size=4), _small_env())
