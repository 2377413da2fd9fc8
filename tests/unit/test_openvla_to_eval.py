"""From a dataset to episodes: a tiny OpenVLA-OFT at K = 4 and 8, and LoRA on top of a plain OpenVLA."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.errors import CheckpointError, SpecMismatchError
from vla_eval.policies.checkpoint import ADAPTER_WEIGHTS_FILE, WEIGHTS_FILE
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot_loading import LoadOptions, load_checkpoint
from vla_eval.policies.merging import merge_adapter
from vla_eval.policies.openvla_paper import make_openvla
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.training.finetune import finetune

TASK = "RememberColor3-v0"
PLAIN = {"head": "tokens", "chunk_size": 1, "n_action_steps": 1}
OFT = {"head": "l1", "chunk_size": 4, "n_action_steps": 4, "use_proprio": True}
SHORT = {"steps": 2, "batch_size": 2, "save_every_steps": 2, "log_every_steps": 1, "num_workers": 0}


@pytest.fixture(autouse=True)
def cache_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def train(recorded: Path, out: Path, *, policy: dict[str, Any], **section: Any) -> Path:
    config = FinetuneConfig(
        policy="openvla_oft_tiny",
        dataset=str(recorded),
        out=str(out),
        finetune={**SHORT, **section, "policy": policy},
        device="cpu",
        allow_unreplayed=True,
    )
    return finetune(config).checkpoint


def context(n_action_steps: int, n_slots: int = 1) -> PolicyContext:
    made: Any = make_env(EnvSettings(task=TASK, simulator="fake"))
    chunking = ChunkingSpec(n_action_steps=n_action_steps)
    return PolicyContext(name="openvla", env=made.spec, chunking=chunking, n_candidates=3, n_slots=n_slots)


def run(checkpoint: Path, n_action_steps: int, **args: Any) -> Any:
    policy: Any = make_openvla(context(n_action_steps), checkpoint=str(checkpoint), device="cpu", **args)
    env = make_env(EnvSettings(task=TASK, simulator="fake", cameras=("base_camera", "hand_camera")))
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="touch it", horizon_steps=8)
    (record,) = rollout(
        env, policy, [start], RolloutSettings(chunking=ChunkingSpec(n_action_steps=n_action_steps))
    )
    return policy, record


@pytest.mark.parametrize("chunk", [4, 8])
def test_a_tiny_one_goes_from_a_dataset_to_an_episode(recorded: Path, tmp_path: Path, chunk: int) -> None:
    sizes = {"chunk_size": chunk, "n_action_steps": chunk}
    checkpoint = train(recorded, tmp_path / "run", policy=sizes)
    for n_action_steps, n_inferences in ((chunk, 8 // chunk), (2, 4)):
        policy, record = run(checkpoint, n_action_steps)
        assert policy.spec.chunk_size == chunk and policy.spec.states == ()
        assert (record.n_steps, record.n_inferences) == (8, n_inferences)
    with pytest.raises(SpecMismatchError, match=f"chunks of {chunk} actions"):
        run(checkpoint, chunk + 1)
    policy, record = run(checkpoint, 2, paper_compat=["gripper_sign", "last_k_queue", "jpeg"])
    assert policy.spec.chunk_size == 2 and record.n_steps == 8


def test_lora_begins_a_head_on_a_plain_openvla_and_merges_exactly(recorded: Path, tmp_path: Path) -> None:
    base = train(recorded, tmp_path / "base", policy=PLAIN)
    lora = {"base_checkpoint": str(base), "lora": {"rank": 2, "alpha": 1}}
    adapter = train(recorded, tmp_path / "oft", policy=OFT, **lora)
    assert (adapter / ADAPTER_WEIGHTS_FILE).is_file() and not (adapter / WEIGHTS_FILE).is_file()
    _, record = run(adapter, 4)
    assert record.n_steps == 8

    merged = merge_adapter(adapter, tmp_path / "merged")
    whole, parts = (load_checkpoint(folder, LoadOptions(device="cpu")) for folder in (merged, adapter))
    batch = {
        "observation.images.base": torch.rand(1, 3, 128, 128),
        "observation.images.wrist": torch.rand(1, 3, 128, 128),
        "observation.state": torch.rand(1, 10),
        "task": ["touch it"],
    }
    told = [
        loaded.postprocessor(loaded.policy.predict_action_chunk(loaded.preprocessor(dict(batch))))
        for loaded in (whole, parts)
    ]
    torch.testing.assert_close(told[0], told[1], atol=1e-5, rtol=1e-5)
    with pytest.raises(CheckpointError, match="no LoRA adapter"):
        merge_adapter(merged, tmp_path / "again")


def test_a_lora_run_that_was_killed_ends_with_the_very_weights_of_one_that_was_not(
    recorded: Path, tmp_path: Path, killed_at: Callable[[int], AbstractContextManager[None]]
) -> None:
    base = train(recorded, tmp_path / "base", policy=PLAIN)
    lora = {"base_checkpoint": str(base), "lora": {"rank": 2, "alpha": 1}, "save_every_steps": 1, "steps": 3}
    straight = train(recorded, tmp_path / "straight", policy=OFT, **lora)
    with killed_at(2):
        train(recorded, tmp_path / "broken", policy=OFT, **lora)
    broken = train(recorded, tmp_path / "broken", policy=OFT, **lora)

    one, other = (load_file(folder / ADAPTER_WEIGHTS_FILE) for folder in (straight, broken))
    assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)
    # The head, which is trained whole, is among them, and has moved since the checkpoint.
    before = load_file(tmp_path / "broken/train/checkpoints/000002/pretrained_model" / ADAPTER_WEIGHTS_FILE)
    moved = {key for key in one if not torch.equal(one[key], before[key])}
    assert any("lora" in key for key in moved) and any("head" in key for key in moved)
