"""From a dataset to episodes: a tiny OpenVLA-OFT and a tiny SpatialVLA, and LoRA on top of them."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from tests.models.tiny_prompted import BASE, BOTH, OPENVLA, SPATIALVLA, WRIST, Ported
from vla_eval.checkpoints.conversion import merge_adapter
from vla_eval.checkpoints.files import ADAPTER_WEIGHTS_FILE, WEIGHTS_FILE
from vla_eval.checkpoints.loading import LoadOptions, load_checkpoint
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.errors import CheckpointError, SpecMismatchError
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.paper_compat import make_paper_compat
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.training.finetune import finetune

TASK = "RememberColor3-v0"
PLAIN = {"head": "tokens", "chunk_size": 1, "n_action_steps": 1}
OFT = {"head": "l1", "chunk_size": 4, "n_action_steps": 4, "use_proprio": True}
UNIFORM = {"action_grid": "uniform"}
REFITTED = {"train_spatial_embeddings": False, "train_word_embeddings": False, "action_grid": "refitted"}
SHORT = {"steps": 2, "batch_size": 2, "save_every_steps": 2, "log_every_steps": 1, "num_workers": 0}


@pytest.fixture(autouse=True)
def cache_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def train(ported: Ported, recorded: Path, out: Path, *, policy: dict[str, Any], **section: Any) -> Path:
    config = FinetuneConfig(
        policy=ported.recipe,
        dataset=str(recorded),
        out=str(out),
        finetune={**SHORT, **section, "policy": policy},
        device="cpu",
        allow_unreplayed=True,
    )
    return finetune(config).checkpoint


def run(ported: Ported, checkpoint: Path, n_action_steps: int, **args: Any) -> Any:
    env: Any = make_env(EnvSettings(task=TASK, simulator="fake", cameras=("base_camera", "hand_camera")))
    chunking = ChunkingSpec(n_action_steps=n_action_steps)
    context = PolicyContext(name="p", env=env.spec, chunking=chunking, n_candidates=3, n_slots=1)
    make: Any = make_paper_compat if ported is OPENVLA else make_lerobot
    policy = make(context, checkpoint=str(checkpoint), device="cpu", **args)
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="touch it", horizon_steps=8)
    (record,) = rollout(env, policy, [start], RolloutSettings(chunking=chunking))
    return policy, record


@pytest.mark.parametrize(
    ("ported", "fields", "chunk"),
    [
        (OPENVLA, {"chunk_size": 4, "n_action_steps": 4}, 4),
        pytest.param(OPENVLA, {"chunk_size": 8, "n_action_steps": 8}, 8, marks=pytest.mark.slow),
        (SPATIALVLA, {"pictures": BOTH}, 4),
    ],
)
def test_a_tiny_one_goes_from_a_dataset_to_an_episode(
    recorded: Path, tmp_path: Path, ported: Ported, fields: dict[str, Any], chunk: int
) -> None:
    checkpoint = train(ported, recorded, tmp_path / "run", policy=fields)
    for n_action_steps, n_inferences in ((chunk, 8 // chunk), (2, 4)):
        policy, record = run(ported, checkpoint, n_action_steps)
        assert policy.spec.chunk_size == chunk and policy.spec.states == ()
        assert (record.n_steps, record.n_inferences) == (8, n_inferences)
    with pytest.raises(SpecMismatchError, match=f"chunks of {chunk} actions"):
        run(ported, checkpoint, chunk + 1)
    if ported is OPENVLA:
        policy, record = run(ported, checkpoint, 2, paper_compat=["gripper_sign", "last_k_queue", "jpeg"])
        assert policy.spec.chunk_size == 2 and record.n_steps == 8


def test_cameras_of_another_field_of_view_are_refused(recorded: Path, tmp_path: Path) -> None:
    checkpoint = train(SPATIALVLA, recorded, tmp_path / "run", policy={"camera_fov_rad": 1.0})
    with pytest.raises(SpecMismatchError, match=r"field of view of base_camera: expected 1\.0000 rad"):
        run(SPATIALVLA, checkpoint, 4)


@pytest.mark.parametrize(
    ("ported", "plain", "fields", "alpha"),
    [
        pytest.param(OPENVLA, PLAIN, OFT, 1, marks=pytest.mark.slow),
        (SPATIALVLA, UNIFORM, REFITTED, 2),
    ],
)
def test_an_adapter_merges_exactly(
    recorded: Path, tmp_path: Path, ported: Ported, plain: dict[str, Any], fields: dict[str, Any], alpha: int
) -> None:
    """OpenVLA begins a head on a plain one; SpatialVLA moves its base to another grid."""
    base = train(ported, recorded, tmp_path / "base", policy=plain)
    lora = {"base_checkpoint": str(base), "lora": {"rank": 2, "alpha": alpha}}
    adapter = train(ported, recorded, tmp_path / "lora", policy=fields, **lora)
    assert (adapter / ADAPTER_WEIGHTS_FILE).is_file() and not (adapter / WEIGHTS_FILE).is_file()
    _, record = run(ported, adapter, 4)
    assert record.n_steps == 8

    merged = merge_adapter(adapter, tmp_path / "merged")
    loaded = [load_checkpoint(folder, LoadOptions(device="cpu")) for folder in (merged, adapter, base)]
    batch = {
        BASE: torch.rand(1, 3, 128, 128),
        WRIST: torch.rand(1, 3, 128, 128),
        "observation.state": torch.rand(1, 10),
        "task": ["touch it"],
    }
    whole, parts = (
        one.postprocessor(one.policy.predict_action_chunk(one.preprocessor(dict(batch))))
        for one in loaded[:2]
    )
    torch.testing.assert_close(whole, parts, atol=1e-5, rtol=1e-5)
    if ported is SPATIALVLA:  # its tokens have moved, once
        tables = [one.policy.network.spatial_embed_tokens.weight for one in loaded]
        assert torch.equal(tables[0], tables[1]) and not torch.equal(tables[0], tables[2])
    with pytest.raises(CheckpointError, match="no LoRA adapter"):
        merge_adapter(merged, tmp_path / "again")


def test_nothing_is_trained_on_an_adapter_whose_base_would_be_moved_twice(
    recorded: Path, tmp_path: Path
) -> None:
    base = train(SPATIALVLA, recorded, tmp_path / "base", policy=UNIFORM)
    lora = {"base_checkpoint": str(base), "lora": {"rank": 2, "alpha": 2}}
    adapter = train(SPATIALVLA, recorded, tmp_path / "lora", policy=REFITTED, **lora)
    with pytest.raises(CheckpointError, match="Merge it"):
        on_top = {**lora, "base_checkpoint": str(adapter)}
        train(SPATIALVLA, recorded, tmp_path / "on_top", policy=REFITTED, **on_top)


def test_a_lora_run_that_was_killed_ends_with_the_very_weights_of_one_that_was_not(
    recorded: Path, tmp_path: Path, killed_at: Callable[[int], AbstractContextManager[None]]
) -> None:
    base = train(OPENVLA, recorded, tmp_path / "base", policy=PLAIN)
    lora = {"base_checkpoint": str(base), "lora": {"rank": 2, "alpha": 1}, "save_every_steps": 1, "steps": 3}
    straight = train(OPENVLA, recorded, tmp_path / "straight", policy=OFT, **lora)
    with killed_at(2):
        train(OPENVLA, recorded, tmp_path / "broken", policy=OFT, **lora)
    broken = train(OPENVLA, recorded, tmp_path / "broken", policy=OFT, **lora)

    one, other = (load_file(folder / ADAPTER_WEIGHTS_FILE) for folder in (straight, broken))
    assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)
    # The head, which is trained whole, is among them, and has moved since the checkpoint.
    before = load_file(tmp_path / "broken/train/checkpoints/000002/pretrained_model" / ADAPTER_WEIGHTS_FILE)
    moved = {key for key in one if not torch.equal(one[key], before[key])}
    assert any("lora" in key for key in moved) and any("head" in key for key in moved)
