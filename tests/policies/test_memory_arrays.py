"""What a policy remembers, taken out and put back: complete, or refused with a reason."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.checkpoints import small_checkpoints
from tests.checkpoints.small_checkpoints import context_for, observation, save, start, with_features
from tests.models.sequence.test_sequence_parts import SMALL_OPTIONS
from vla_eval.chunking import ChunkingSpec
from vla_eval.core import ObservationWindow
from vla_eval.errors import SpecMismatchError
from vla_eval.models.cores.sizes import CORES
from vla_eval.models.memory.configuration_memory import MikasaMemoryConfig
from vla_eval.models.sequence.configuration_sequence import MikasaSequenceConfig
from vla_eval.models.shared.earlier_frames import FrameMemory
from vla_eval.models.shared.frame_choice import RULES, FrameChoice
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.specs import EnvSpec
from vla_eval.testing import check_policy

pytestmark = pytest.mark.usefixtures("no_network")
backbone, env = small_checkpoints.backbone, small_checkpoints.env
act, diffusion = small_checkpoints.act, small_checkpoints.diffusion

COMMON: dict[str, Any] = {
    "device": "cpu",
    "push_to_hub": False,
    "chunk_size": 4,
    "n_action_steps": 4,
    "window_steps": 60,
}
SMALL = {"width": 16, "heads": 2, "context_steps": 3}
REMEMBERING = [core for core, row in CORES.items() if row.remembers]
OFTEN = ("memory", "gru", "gtrxl")  # one of each kind: named parts, a state, cached steps
NAMES = [
    name if name in OFTEN else pytest.param(name, marks=pytest.mark.slow) for name in ("memory", *REMEMBERING)
]


def config_of(name: str) -> Any:
    if name == "memory":
        return MikasaMemoryConfig(**COMMON)
    options = SMALL_OPTIONS.get(name, {})
    return MikasaSequenceConfig(**COMMON, **SMALL, core=name, core_options=options)


@pytest.fixture(params=NAMES)
def remembering(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return save(with_features(config_of(request.param)), tmp_path / "model")


def make(checkpoint: Path, env: EnvSpec, **args: Any) -> LeRobotPolicy:
    return make_lerobot(context_for(env), checkpoint=str(checkpoint), **args)


def test_an_episode_continues_bit_equal_with_the_memory_that_was_handed_back(
    remembering: Path, env: EnvSpec
) -> None:
    met = check_policy(lambda: make(remembering, env), env)
    assert sum("memory is read, lost, and put back" in claim for claim in met) == 2


def two_slots(env: EnvSpec) -> PolicyContext:
    chunking = ChunkingSpec(n_action_steps=4)
    return PolicyContext(name="p", env=env, chunking=chunking, n_candidates=3, n_slots=2)


def at(step: int) -> ObservationWindow:
    return ObservationWindow(slot=0, frames=(observation(step, level=100 + 20 * step),))


def begun(policy: LeRobotPolicy, *, n_inferences: int = 1) -> LeRobotPolicy:
    """Return the policy in an episode of slot 0 after so many inferences."""
    policy.reset([start(0, seed=1)])
    for step in range(n_inferences):
        policy.act(at(step))
    return policy


@pytest.fixture
def gru(tmp_path: Path) -> Path:
    return save(with_features(config_of("gru")), tmp_path / "model")


def test_a_memory_has_the_same_names_and_shapes_alone_and_in_a_pass_of_several(
    gru: Path, env: EnvSpec
) -> None:
    alone, batched = begun(make(gru, env)), begun(make_lerobot(two_slots(env), checkpoint=str(gru)))
    found = [
        {name: (part.shape, part.dtype) for name, part in policy.get_memory(0).items()}
        for policy in (alone, batched)
    ]
    assert found[0] == found[1]
    batched.set_memory(0, alone.get_memory(0))
    for name, part in alone.get_memory(0).items():
        assert np.array_equal(batched.get_memory(0)[name], part)


def test_before_the_first_frame_a_memory_is_what_an_episode_begins_with(gru: Path, env: EnvSpec) -> None:
    policy = make(gru, env)
    first = begun(policy, n_inferences=0).get_memory(0)
    after = begun(policy, n_inferences=2).get_memory(0)
    assert any(not np.array_equal(after[name], first[name]) for name in first)
    policy.set_memory(0, first)
    again = policy.act(at(2)).actions
    assert not np.array_equal(again, begun(policy, n_inferences=2).act(at(2)).actions)


def test_changing_what_was_returned_or_given_changes_no_episode(gru: Path, env: EnvSpec) -> None:
    policy = begun(make(gru, env))
    kept, given = policy.get_memory(0), policy.get_memory(0)
    policy.set_memory(0, given)
    for part in (*given.values(), *policy.get_memory(0).values()):
        part[...] = 7
    for name, part in policy.get_memory(0).items():
        assert np.array_equal(part, kept[name])


def test_a_memory_of_another_form_is_refused_and_changes_nothing(
    diffusion: Path, gru: Path, env: EnvSpec
) -> None:
    for policy in (begun(make(gru, env)), begun(make(diffusion, env))):
        kept = policy.get_memory(0)
        for name, part in kept.items():
            others = [
                {**kept, name: part.astype(np.float64)},
                {**kept, name: part[..., :-1]},
                {**kept, name: np.concatenate([part, part, part])},
                {**kept, name: np.array(0, np.float32)},
                {other: value for other, value in kept.items() if other != name},
                {**kept, f"{name}x": part},
            ]
            for memory in others:
                if not memory:  # a memory of frames alone may be empty: it is that of the beginning
                    continue
                with pytest.raises(SpecMismatchError, match=r"policy 'p', set_memory: .*expected .* found"):
                    policy.set_memory(0, memory)
        for name, part in policy.get_memory(0).items():
            assert np.array_equal(part, kept[name])


def test_a_policy_that_keeps_nothing_says_so(act: Path, env: EnvSpec) -> None:
    policy = begun(make(act, env))
    assert not policy.spec.has_memory
    assert policy.get_memory(0) == {}
    with pytest.raises(SpecMismatchError, match="expected no arrays, found 'policy/0'"):
        policy.set_memory(0, {"policy/0": np.zeros(3, np.float32)})


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("n_frames", [0, 1, 3, 20])
def test_earlier_frames_continue_as_they_were(rule: str, n_frames: int) -> None:
    choice = FrameChoice(rule=rule, n_places=3, stride=2, least_novelty=0.05)
    rng = np.random.default_rng(0)
    # Blocks that stand out appear now and then: the rule `keyframes` finds events among them.
    frames = []
    for number in range(n_frames + 6):
        image = np.full((3, 64, 64), 0.5, np.float32)
        image[:, 8:16, 8 * (number // 3 % 6) : 8 * (number // 3 % 6) + 8] = rng.random((3, 1, 1))
        frames.append({"a": torch.from_numpy(image), "b": torch.from_numpy(1 - image)})
    memory = FrameMemory(choice=choice, cameras=("a", "b"))
    for frame in frames[:n_frames]:
        memory = memory.after(frame)
    moved = FrameMemory(choice=choice, cameras=("a", "b")).with_arrays(memory.arrays())
    for frame in frames[n_frames:]:
        memory, moved = memory.after(frame), moved.after(frame)
        for name, image in memory.fields().items():
            assert torch.equal(moved.fields()[name], image)
    assert rule != "keyframes" or memory.seen.events
