"""From a dataset to episodes: a tiny SpatialVLA, and LoRA on top of it on a grid that is fitted anew."""

from pathlib import Path
from typing import Any

import pytest
import torch

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.errors import CheckpointError, SpecMismatchError
from vla_eval.policies.checkpoint import ADAPTER_WEIGHTS_FILE, WEIGHTS_FILE
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot import make_lerobot
from vla_eval.policies.lerobot_loading import LoadOptions, load_checkpoint
from vla_eval.policies.merging import merge_adapter
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.training.finetune import finetune

TASK = "RememberColor3-v0"
SHORT = {"steps": 2, "batch_size": 2, "save_every_steps": 2, "log_every_steps": 1, "num_workers": 0}
BOTH = ["observation.images.base", "observation.images.wrist"]


@pytest.fixture(autouse=True)
def cache_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def train(recorded: Path, out: Path, *, policy: dict[str, Any], **section: Any) -> Path:
    config = FinetuneConfig(
        policy="spatialvla_tiny",
        dataset=str(recorded),
        out=str(out),
        finetune={**SHORT, **section, "policy": policy},
        device="cpu",
        allow_unreplayed=True,
    )
    return finetune(config).checkpoint


def run(checkpoint: Path, n_action_steps: int) -> Any:
    env: Any = make_env(EnvSettings(task=TASK, simulator="fake", cameras=("base_camera", "hand_camera")))
    chunking = ChunkingSpec(n_action_steps=n_action_steps)
    context = PolicyContext(name="spatialvla", env=env.spec, chunking=chunking, n_candidates=3, n_slots=1)
    policy = make_lerobot(context, checkpoint=str(checkpoint), device="cpu")
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="touch it", horizon_steps=8)
    (record,) = rollout(env, policy, [start], RolloutSettings(chunking=chunking))
    return policy, record


def test_a_tiny_one_goes_from_a_dataset_to_an_episode(recorded: Path, tmp_path: Path) -> None:
    checkpoint = train(recorded, tmp_path / "run", policy={"pictures": BOTH})
    for n_action_steps, n_inferences in ((4, 2), (2, 4)):
        policy, record = run(checkpoint, n_action_steps)
        assert policy.spec.chunk_size == 4 and policy.spec.states == ()
        assert (record.n_steps, record.n_inferences) == (8, n_inferences)


def test_cameras_of_another_field_of_view_are_refused(recorded: Path, tmp_path: Path) -> None:
    checkpoint = train(recorded, tmp_path / "run", policy={"camera_fov_rad": 1.0})
    with pytest.raises(SpecMismatchError, match=r"field of view of base_camera: expected 1\.0000 rad"):
        run(checkpoint, 4)


def test_lora_moves_the_base_to_another_grid_whenever_it_is_loaded_and_merges_exactly(
    recorded: Path, tmp_path: Path
) -> None:
    base = train(recorded, tmp_path / "base", policy={"action_grid": "uniform"})
    lora = {"base_checkpoint": str(base), "lora": {"rank": 2, "alpha": 2}}
    frozen = {"train_spatial_embeddings": False, "train_word_embeddings": False, "action_grid": "refitted"}
    adapter = train(recorded, tmp_path / "lora", policy=frozen, **lora)
    assert (adapter / ADAPTER_WEIGHTS_FILE).is_file() and not (adapter / WEIGHTS_FILE).is_file()
    _, record = run(adapter, 4)
    assert record.n_steps == 8

    merged = merge_adapter(adapter, tmp_path / "merged")
    options = LoadOptions(device="cpu")
    whole, parts, before = (load_checkpoint(folder, options) for folder in (merged, adapter, base))
    tables = [loaded.policy.network.spatial_embed_tokens.weight for loaded in (whole, parts, before)]
    assert torch.equal(tables[0], tables[1]) and not torch.equal(tables[0], tables[2])
    batch = {
        "observation.images.base": torch.rand(1, 3, 128, 128),
        "observation.images.wrist": torch.rand(1, 3, 128, 128),
        "task": ["touch it"],
    }
    told = [
        loaded.postprocessor(loaded.policy.predict_action_chunk(loaded.preprocessor(dict(batch))))
        for loaded in (whole, parts)
    ]
    torch.testing.assert_close(told[0], told[1], atol=1e-5, rtol=1e-5)
    # On an adapter nothing can begin: its base would be moved twice.
    with pytest.raises(CheckpointError, match="Merge it"):
        train(recorded, tmp_path / "again", policy=frozen, **{**lora, "base_checkpoint": str(adapter)})
