"""Chunks that join: what is committed reaches a flow policy's network in its own numbers."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch

from tests.checkpoints import small_checkpoints
from tests.checkpoints.small_checkpoints import (
    FAKE,
    context_for,
    observation,
    start,
    statistics,
    window,
)
from vla_eval.chunking import ChunkingSpec, Mode, RtcSettings
from vla_eval.core import CommittedActions, FloatArray, ObservationWindow
from vla_eval.envs.factory import make_env
from vla_eval.errors import InvalidActionError, SpecMismatchError
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import EnvSpec
from vla_eval.testing.tiny_models import make_tiny

pytestmark = pytest.mark.usefixtures("no_network")
backbone, env = small_checkpoints.backbone, small_checkpoints.env
act, pi0 = small_checkpoints.act, small_checkpoints.pi0

CHUNK = 4  # of the tiny π0


def context(env: EnvSpec, mode: Mode = "rtc", *, n_slots: int = 1, **rtc: Any) -> PolicyContext:
    chunking = ChunkingSpec(n_action_steps=2, mode=mode, delay=1, rtc=RtcSettings(**rtc))
    return dataclasses.replace(context_for(env), chunking=chunking, n_slots=n_slots)


def policy(pi0: Path, env: EnvSpec, **fields: Any) -> LeRobotPolicy:
    made: LeRobotPolicy = make_tiny(context(env, **fields), checkpoint=str(pi0))
    return made


def told(actions: FloatArray, n_frozen: int, *, slot: int = 0, step: int = 0) -> ObservationWindow:
    committed = CommittedActions(actions=actions, n_frozen=n_frozen)
    return dataclasses.replace(window(slot, observation(step)), committed=committed)


def committed(n: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (n, 7)).astype(np.float32)


def chunk(made: LeRobotPolicy, asked: ObservationWindow, *, seed: int = 1) -> FloatArray:
    made.reset([start(asked.slot, seed=seed)])
    return made.act(asked).actions


def test_with_weights_of_zero_a_chunk_is_the_unguided_one_bit_for_bit(pi0: Path, env: EnvSpec) -> None:
    plain = chunk(make_tiny(context_for(env), checkpoint=str(pi0)), window())
    made = policy(pi0, env, prefix_attention_schedule="zeros")

    assert chunk(made, told(committed(3), 0)).tobytes() == plain.tobytes()
    assert chunk(made, told(committed(0), 0)).tobytes() == plain.tobytes()  # nothing is committed
    assert chunk(made, told(committed(3), 1)).tobytes() != plain.tobytes()


@pytest.mark.slow
def test_guided_chunks_are_nearer_to_the_committed_rows_than_unguided_ones(pi0: Path, env: EnvSpec) -> None:
    plain, made = make_tiny(context_for(env), checkpoint=str(pi0)), policy(pi0, env)
    scale = statistics()["action"]["std"]
    nearer = []
    for seed in range(100):
        rows = committed(3, seed)
        ways = (chunk(plain, window(), seed=seed), chunk(made, told(rows, 2), seed=seed))
        before, after = (float((np.abs(way[:2] - rows[:2]) / scale).mean()) for way in ways)
        nearer.append(after < before)

    assert sum(nearer) >= 95


def test_the_network_is_given_what_is_committed_in_its_own_numbers(pi0: Path, env: EnvSpec) -> None:
    """The checkpoint normalises by mean and standard deviation."""
    made = policy(pi0, env, execution_horizon=3, max_guidance_weight=5.0)
    network, given = made._loaded.policy, {}
    predict = network.predict_action_chunk

    def noting(batch: Any, **extra: Any) -> Any:
        given.update(extra, keys=set(batch))
        return predict(batch, **extra)

    network.predict_action_chunk = noting
    rows = committed(3)
    chunk(made, told(rows, 2))

    known = statistics()["action"]
    expected = (rows - known["mean"]) / known["std"]
    np.testing.assert_allclose(given["prev_chunk_left_over"][0].numpy(), expected, atol=1e-5)
    assert (given["inference_delay"], given["execution_horizon"]) == (2, 3)
    assert "action" not in given["keys"]
    assert made._loaded.config.rtc_config.max_guidance_weight == 5.0


def test_episodes_with_other_committed_steps_are_passes_of_their_own_with_the_same_bits(
    pi0: Path, env: EnvSpec
) -> None:
    made = policy(pi0, env, n_slots=3)
    asked = [
        told(committed(3, 0), 1, slot=0),
        told(committed(2, 1), 1, slot=1),
        told(committed(3, 2), 1, slot=2),
    ]

    def actions(*slots: int) -> dict[int, bytes]:
        made.reset([start(slot, seed=slot + 1, row=slot) for slot in slots])
        chunks = made.act_batch([asked[slot] for slot in slots])
        return {slot: one.actions.tobytes() for slot, one in zip(slots, chunks, strict=True)}

    together, alone = actions(0, 1, 2), {slot: actions(slot)[slot] for slot in range(3)}
    assert together == alone
    assert together == actions(2, 1, 0)


def test_what_cannot_be_given_back_is_not_given_to_the_network(pi0: Path, env: EnvSpec) -> None:
    made = policy(pi0, env)
    undo = made._loaded.postprocessor

    def wrong(actions: Any) -> Any:
        return undo(actions) * torch.tensor([1, 1, 1, 1.1, 1, 1, 1])

    made._loaded = dataclasses.replace(made._loaded, postprocessor=wrong)
    with pytest.raises(InvalidActionError, match=r"the action .* \(dimension 3\) comes back as"):
        chunk(made, told(committed(3), 1))


@pytest.mark.parametrize(("mode", "problem"), [("rtc", "cannot be guided"), ("prefix", "was not trained to")])
def test_a_policy_that_cannot_is_refused_when_it_is_made(
    act: Path, env: EnvSpec, mode: Mode, problem: str
) -> None:
    with pytest.raises(SpecMismatchError, match=problem):
        make_lerobot(context(env, mode), checkpoint=str(act))


def test_a_flow_policy_without_prefixes_in_training_is_refused_in_that_mode(pi0: Path, env: EnvSpec) -> None:
    with pytest.raises(SpecMismatchError, match=r"not trained to continue a prefix.*prefix_steps"):
        policy(pi0, env, mode="prefix")


@pytest.mark.parametrize("mode", get_args(Mode))
def test_only_the_modes_that_commit_tell_a_policy(pi0: Path, env: EnvSpec, mode: Mode) -> None:
    if mode == "prefix":
        pytest.skip("π0 is not trained for it")

    assert policy(pi0, env, mode=mode).spec.reads_committed == (mode == "rtc")


def test_in_the_loop_the_rows_executed_meanwhile_are_the_old_chunks(pi0: Path, env: EnvSpec) -> None:
    made, seen = policy(pi0, env), []
    infer = made.act_batch

    def noting(windows: Any) -> Any:
        chunks = infer(windows)
        seen.extend((one.committed, found.actions) for one, found in zip(windows, chunks, strict=True))
        return chunks

    made.act_batch = noting  # type: ignore[method-assign]
    episode = dataclasses.replace(start(), horizon_steps=9)
    (record,) = rollout(make_env(FAKE), made, [episode], RolloutSettings(chunking=context(env).chunking))

    assert (record.n_inferences, record.n_held_steps) == (5, 1)  # at 0, 2, 4, 6, 8
    for (_, before), (now, _) in itertools.pairwise(seen):
        assert now is not None
        assert now.n_frozen == 1
        assert now.actions.tobytes() == before[2:].tobytes()
