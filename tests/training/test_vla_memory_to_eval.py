"""SmolVLA and π0.5 with memory, tiny: from a base over a kill to episodes."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tests.models.vla_memory.tiny_vlas import TINY_SMOLVLA
from tests.training import tiny_trainings
from tests.training.tiny_trainings import SHORT, TASK, context, pi0
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.checkpoints.loading import LoadOptions
from vla_eval.checkpoints.verify import verify_checkpoint
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.core import EpisodeStart, FloatArray
from vla_eval.envs.factory import make_env
from vla_eval.errors import RecipeError
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.testing.tiny_models import TINY_POLICY, tiny_paligemma, write_tiny_smolvlm
from vla_eval.training.finetune import finetune

tokenizer = tiny_trainings.tokenizer
offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own
KilledAt = Callable[[int], AbstractContextManager[None]]
FRAMES = {"memory_places": 2, "memory_rule": "keyframes", "memory_novelty": 0.02}
TOKENS = {"memory_tokens": 3, "token_stride": 3, "token_segments": 2}


def weights(run: Path) -> dict[str, torch.Tensor]:
    return dict(load_file(find_checkpoint(run) / "model.safetensors"))


def assert_killed_is_straight(
    make: Callable[[Path], FinetuneConfig], folder: Path, killed_at: KilledAt
) -> Path:
    """Train twice, once with a kill; return the run that was killed."""
    straight, broken = folder / "straight", folder / "broken"
    finetune(make(straight))
    with killed_at(3):
        finetune(make(broken))
    finetune(make(broken))
    one, other = weights(straight), weights(broken)
    assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)
    return broken


def actions_of(
    policy: LeRobotPolicy, *, slots: tuple[int, ...], n_action_steps: int
) -> dict[int, FloatArray]:
    """Return seed -> the actions of an episode; episodes in several slots run side by side."""
    # The arm does not move before step 10: what is seen does not depend on what is done.
    env: Any = make_env(
        EnvSettings(
            task=TASK,
            kwargs={"freeze_until_choice": True},
            simulator="fake",
            cameras=("base_camera", "hand_camera"),
        )
    )
    done: dict[int, list[FloatArray]] = {slot: [] for slot in slots}
    step = env.step

    def watched(actions: Any, **options: Any) -> Any:
        for slot, action in actions.items():
            done[slot].append(action)
        return step(actions, **options)

    env.step = watched
    starts = [
        EpisodeStart(slot=s, row=s, task=TASK, seed=s, run=0, instruction="touch it", horizon_steps=8)
        for s in slots
    ]
    settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=n_action_steps))
    assert all(record.error is None for record in rollout(env, policy, starts, settings))
    return {slot: np.stack(actions) for slot, actions in done.items()}


@pytest.mark.slow
def test_pi05_with_frames_and_tokens_begins_from_a_base_resumes_and_acts(
    recorded: Path, tmp_path: Path, tokenizer: Path, killed_at: KilledAt
) -> None:
    base = tmp_path / "base"
    policy = {**TINY_POLICY, "gradient_checkpointing": False, "scheduler_decay_steps": 4}

    def with_memory(out: Path) -> FinetuneConfig:
        fields = {"base_checkpoint": str(base), "policy": {**policy, **FRAMES, **TOKENS}}
        return pi0(recorded, out, tokenizer, type="mikasa_pi05", micro_batch_size=1, **fields)

    with tiny_paligemma("pi05"):
        finetune(pi0(recorded, base, tokenizer, type="pi05", steps=2))
        run = assert_killed_is_straight(with_memory, tmp_path, killed_at)
        new = {name.split(".")[0] for name in weights(run).keys() - weights(base).keys()}
        assert new == {"memory_tokens"}
        verify_checkpoint(run, LoadOptions(device="cpu"))

        alone = make_lerobot(context(), checkpoint=str(run))
        assert alone.spec.reads == "every"
        actions = {n: actions_of(alone, slots=(0,), n_action_steps=n)[0] for n in (1, 2)}
        assert all(np.isfinite(values).all() for values in actions.values())
        # What is remembered at a step does not depend on how often the policy was asked before.
        np.testing.assert_allclose(actions[1][::2], actions[2][::2], atol=1e-5)
        in_rows = make_lerobot(replace(context(), n_slots=2), checkpoint=str(run))
        beside = actions_of(in_rows, slots=(0, 1), n_action_steps=2)
        np.testing.assert_allclose(beside[0], actions[2], atol=1e-4)


def test_smolvla_with_frames_resumes_and_acts(recorded: Path, tmp_path: Path, killed_at: KilledAt) -> None:
    recipe = tmp_path / "tiny.yaml"
    recipe.write_text("version: 1\ndescription: tiny\nadapter: lerobot\nfinetune: {type: mikasa_smolvla}\n")
    vlm = write_tiny_smolvlm(tmp_path / "vlm")
    policy = {**TINY_SMOLVLA, **FRAMES, "memory_rule": "last", "memory_stride": 3, "vlm_model_name": str(vlm)}

    def with_memory(out: Path, **changes: Any) -> FinetuneConfig:
        return FinetuneConfig(
            **{"policy": str(recipe), "dataset": str(recorded), "out": str(out), "device": "cpu"},
            finetune={**SHORT, "policy": policy, **changes},
            allow_unreplayed=True,
        )

    run = assert_killed_is_straight(with_memory, tmp_path, killed_at)
    policy_with_frames = make_lerobot(context(), checkpoint=str(run))
    assert policy_with_frames.spec.cameras == ("base_camera", "hand_camera")
    assert np.isfinite(actions_of(policy_with_frames, slots=(0,), n_action_steps=4)[0]).all()
    with pytest.raises(RecipeError, match=r"decode_ahead is false; 'mikasa_smolvla' is trained"):
        finetune(with_memory(tmp_path / "refused", decode_ahead=False))


def test_a_base_of_another_type_is_refused_and_both_that_fit_are_named(
    recorded: Path, tmp_path: Path, tokenizer: Path
) -> None:
    base = tmp_path / "base"
    with tiny_paligemma("pi0"):
        finetune(pi0(recorded, base, tokenizer, steps=2))
    config = pi0(recorded, tmp_path / "run", tokenizer, type="mikasa_pi05", base_checkpoint=str(base))
    with pytest.raises(RecipeError, match="holds a 'pi0', expected a 'pi05' or a 'mikasa_pi05'"):
        finetune(config)
