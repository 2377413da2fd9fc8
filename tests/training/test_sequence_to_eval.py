"""Each sequence model of the recipes at tiny size: train, kill, go on, load, evaluate."""

import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from tests.training import tiny_trainings
from tests.training.tiny_trainings import TASK, context
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.errors import RecipeError
from vla_eval.models.cores.sizes import CORES, ElmurOptions, TransformerXLOptions
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.training.finetune import finetune

offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own

RECIPES = ("decision_transformer", "rate", "gtrxl", "decision_mamba", "elmur")
CAMERAS = ("base_camera", "hand_camera")
SHORT = {"steps": 2, "batch_size": 2, "save_every_steps": 1, "log_every_steps": 1}
KilledAt = Callable[[int], AbstractContextManager[None]]


def tiny(recipe: str, dataset: Path, out: Path, **changes: Any) -> FinetuneConfig:
    """Return the recipe with all sizes small; segments of 4 steps divide episodes of 13 to 15."""
    options = CORES[recipe].options
    sizes: dict[str, Any] = {"width": 16, "layers": 1, "heads": 2, "context_steps": 4, "chunk_size": 3}
    if isinstance(options, TransformerXLOptions):
        memory = {"memory_tokens": 2, "valve_heads": 2} if options.memory_tokens else {}
        cached = {"cached_tokens": 9} if options.cached_tokens else {}
        sizes["core_options"] = {"head_width": 4, **memory, **cached}
    if isinstance(options, ElmurOptions):
        sizes["core_options"] = {"slots": 3, "experts": 2, "inner_width": 4}
    return FinetuneConfig(
        policy=recipe,
        dataset=str(dataset),
        out=str(out),
        run_seed=3,
        finetune={**SHORT, "policy": {**sizes, "n_action_steps": 2}, **changes},
        device="cpu",
        allow_unreplayed=True,
    )


def chunks_of_an_episode(policy: Any) -> int:
    env = make_env(EnvSettings(task=TASK, simulator="fake", cameras=CAMERAS))
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="touch it", horizon_steps=10)
    (record,) = rollout(env, policy, [start], RolloutSettings(chunking=ChunkingSpec(n_action_steps=2)))
    assert record.n_inferences is not None
    return record.n_inferences


@pytest.mark.parametrize(
    "recipe",
    [
        pytest.param(name, marks=() if name in ("decision_transformer", "elmur") else pytest.mark.slow)
        for name in RECIPES
    ],
)
def test_it_is_trained_killed_resumed_to_the_same_weights_and_evaluated(
    recipe: str, recorded: Path, tmp_path: Path, killed_at: KilledAt
) -> None:
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    finetune(tiny(recipe, recorded, straight))
    with killed_at(1):
        finetune(tiny(recipe, recorded, broken))
    finetune(tiny(recipe, recorded, broken))
    one, other = (load_file(find_checkpoint(run) / "model.safetensors") for run in (straight, broken))
    assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)
    policy = make_lerobot(context(), checkpoint=str(broken))
    assert policy.spec.reads == "every"
    assert chunks_of_an_episode(policy) == 5  # 10 steps, 2 actions each; the third segment has begun


@pytest.mark.parametrize("recipe", ["rate", pytest.param("elmur", marks=pytest.mark.slow)])
def test_episodes_in_one_pass_get_the_chunks_of_a_pass_of_their_own(
    recipe: str, recorded: Path, tmp_path: Path
) -> None:
    finetune(tiny(recipe, recorded, tmp_path / "run"))
    env = make_env(EnvSettings(task=TASK, simulator="fake", cameras=CAMERAS, n_slots=2))
    starts = [
        EpisodeStart(slot=i, row=i, task=TASK, seed=i + 1, run=0, instruction="touch it", horizon_steps=10)
        for i in range(2)
    ]
    settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=2))
    two_rows = dataclasses.replace(context(), n_slots=2)
    digests = []
    for episodes in (starts, starts[:1]):
        policy = make_lerobot(two_rows, checkpoint=str(tmp_path / "run"))
        digests.append(rollout(env, policy, episodes, settings)[0].trajectory_sha256)
    assert digests[0] == digests[1]


def test_rewards_are_served_from_decoded_frames_alone(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"decode_ahead is false; 'mikasa_sequence' is trained on whole"):
        finetune(tiny("rate", recorded, tmp_path / "o", decode_ahead=False))


def in_one_storage(cells: nn.RNNBase) -> None:
    """What `flatten_parameters` does on a GPU, done on a CPU: all weights become parts of one storage."""
    weights = list(cells.parameters())
    whole = torch.cat([weight.detach().flatten() for weight in weights])
    for weight, part in zip(weights, whole.split([weight.numel() for weight in weights]), strict=True):
        weight.data = part.view_as(weight)


@pytest.mark.parametrize("kind", [pytest.param("gru", marks=pytest.mark.slow), "lstm"])
def test_recurrent_weights_that_share_a_storage_are_saved_resumed_and_evaluated(
    kind: str, recorded: Path, tmp_path: Path, killed_at: KilledAt, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(name: str) -> FinetuneConfig:
        sizes = {
            "core": kind,
            "core_options": {},
            "width": 16,
            "layers": 2,
            "chunk_size": 3,
            "n_action_steps": 2,
        }
        return dataclasses.replace(
            tiny("gtrxl", recorded, tmp_path / name), policy="recurrent", finetune={**SHORT, "policy": sizes}
        )

    finetune(run("apart"))
    monkeypatch.setattr(nn.RNNBase, "flatten_parameters", in_one_storage)
    with killed_at(1):
        finetune(run("one_storage"))
    finetune(run("one_storage"))
    apart, one = (
        load_file(find_checkpoint(tmp_path / name) / "model.safetensors") for name in ("apart", "one_storage")
    )
    assert apart.keys() == one.keys() and all(torch.equal(apart[key], one[key]) for key in apart)
    assert chunks_of_an_episode(make_lerobot(context(), checkpoint=str(tmp_path / "one_storage"))) == 5
