"""One policy for two tasks: mixed, trained, killed, resumed, evaluated on both."""

import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from tests.data.second_task import SENTENCE, write_second_task
from tests.data.second_task import TASK as SECOND
from tests.training import tiny_trainings
from tests.training.tiny_trainings import SHORT, TASK, context
from vla_eval.checkpoints.files import find_checkpoint, read_facts
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.core import EpisodeStart
from vla_eval.data.derived.mixing import mix_datasets
from vla_eval.envs.factory import make_env
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.training.dry_run import DryRunOptions, describe_finetuning
from vla_eval.training.finetune import finetune

offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own

KilledAt = Callable[[int], AbstractContextManager[None]]
TINY = {
    "memory_many": {"channels": 4, "heads": 2, "key": 4, "memory": 8, "hidden": 16},
    "context_many": {"width": 16, "heads": 2, "layers": 1, "context_steps": 20},
}


@pytest.fixture
def mixed(recorded: Path, tmp_path: Path) -> Path:
    mix_datasets([recorded, write_second_task(recorded)], tmp_path / "mixed")
    return tmp_path / "mixed"


def asked(policy: str, dataset: Path, out: Path) -> FinetuneConfig:
    sizes = {**TINY[policy], "chunk_size": 3, "n_action_steps": 2}
    return FinetuneConfig(
        policy=policy,
        dataset=str(dataset),
        out=str(out),
        run_seed=3,
        finetune={**SHORT, "policy": sizes},
        device="cpu",
        allow_unreplayed=True,
    )


def acted(run: Path, task: str, instruction: str) -> str | None:
    """Return the digest of actions and states of an episode of 6 steps."""
    env = make_env(EnvSettings(task=task, simulator="fake", cameras=("base_camera", "hand_camera")))
    policy = make_lerobot(context(), checkpoint=str(run))
    start = EpisodeStart(slot=0, task=task, seed=1, run=0, instruction=instruction, horizon_steps=6)
    (record,) = rollout(env, policy, [start], RolloutSettings(chunking=ChunkingSpec(n_action_steps=2)))
    assert record.error is None
    return record.trajectory_sha256


@pytest.mark.slow
@pytest.mark.parametrize(
    "policy", [pytest.param(x, marks=pytest.mark.slow) if x == "memory_many" else x for x in TINY]
)
def test_two_tasks_are_learned_at_once_and_a_killed_run_ends_with_the_same_weights(
    policy: str, mixed: Path, tmp_path: Path, killed_at: KilledAt
) -> None:
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    lines: list[str] = []
    finetune(asked(policy, mixed, straight), say=lines.append)
    with killed_at(3):
        finetune(asked(policy, mixed, broken))
    finetune(asked(policy, mixed, broken))
    one, other = (load_file(find_checkpoint(run) / "model.safetensors") for run in (straight, broken))
    assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)
    assert any(name.startswith("network.sentence") for name in one)

    (line, *_) = (json.loads(text) for text in (straight / "metrics.jsonl").read_text().splitlines())
    assert (line["episodes"], line["epochs"]) == (line["samples"], line["samples"] / 6)
    assert f"tasks: {TASK}, {SECOND}" in lines
    facts = read_facts(find_checkpoint(straight))
    assert facts is not None
    assert (facts.task, facts.tasks) == ("", (TASK, SECOND))
    assert json.loads((straight / "finetune.json").read_text())["tasks"] == [TASK, SECOND]

    assert acted(straight, TASK, "look, wait, choose") != acted(straight, TASK, SENTENCE)
    assert acted(straight, SECOND, SENTENCE) == acted(straight, SECOND, SENTENCE.upper())


def test_a_dry_run_counts_the_episodes_of_all_tasks(mixed: Path, tmp_path: Path) -> None:
    options = DryRunOptions(device_bytes=None, tflops=None)
    config = asked("memory_many", mixed, tmp_path / "run")
    passes = SHORT["steps"] * SHORT["batch_size"] / 6
    lines = describe_finetuning(config, options)
    assert f"dataset: 6 episodes of 82 frames, each a sample; {passes:.1f} passes over them" in lines
