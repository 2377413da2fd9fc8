"""Trainings of some steps of a tiny ACT and a tiny π0, offline, with a cache of their own."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.envs.factory import make_env
from vla_eval.policies.context import PolicyContext
from vla_eval.testing.tiny_models import TINY_POLICY, write_tiny_tokenizer
from vla_eval.training import finetune as finetune_module

TASK = "RememberColor3-v0"
TINY_ACT = {
    "chunk_size": 4,
    "n_action_steps": 4,
    "dim_model": 32,
    "n_heads": 2,
    "dim_feedforward": 32,
    "n_encoder_layers": 1,
    "n_vae_encoder_layers": 1,
    "latent_dim": 8,
    "dropout": 0.1,
}
SHORT = {
    "steps": 4,
    "batch_size": 2,
    "save_every_steps": 2,
    "log_every_steps": 1,
    "num_workers": 0,
    "decode_ahead": True,
}


@pytest.fixture(autouse=True)
def offline_with_a_cache_of_its_own(
    no_network: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def act(dataset: Path, out: Path, **changes: Any) -> FinetuneConfig:
    return FinetuneConfig(
        policy="act",
        dataset=str(dataset),
        out=str(out),
        run_seed=3,
        finetune={**SHORT, "policy": TINY_ACT, **changes},
        device="cpu",
        allow_unreplayed=True,
    )


def pi0(dataset: Path, out: Path, tokenizer: Path, **changes: Any) -> FinetuneConfig:
    finetune = {"tokenizer": str(tokenizer), "base_checkpoint": None, "rename_cameras": {}, **changes}
    recipe = dict(finetune)
    policy = {**TINY_POLICY, "gradient_checkpointing": False, "scheduler_decay_steps": 4}
    return FinetuneConfig(
        policy=str(dataset.parent / "tiny_pi0.yaml"),
        dataset=str(dataset),
        out=str(out),
        finetune={**SHORT, "policy": policy, **recipe},
        device="cpu",
        allow_unreplayed=True,
    )


def finetune_losses(config: FinetuneConfig) -> list[float]:
    """Train, and return the loss of each step."""
    finetune_module.finetune(config)
    lines = (Path(str(config.out)) / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line)["loss"] for line in lines]


@pytest.fixture
def tokenizer(tmp_path: Path, recorded: Path) -> Path:
    (recorded.parent / "tiny_pi0.yaml").write_text(
        "version: 1\ndescription: tiny\nadapter: lerobot\nfinetune: {type: pi0}\n"
    )
    return write_tiny_tokenizer(tmp_path / "tokenizer")


def context() -> PolicyContext:
    env: Any = make_env(EnvSettings(task=TASK, simulator="fake"))
    return PolicyContext(name="p", env=env.spec, chunking=ChunkingSpec(n_action_steps=2), n_candidates=3)


def asked_for(monkeypatch: pytest.MonkeyPatch) -> list[FinetuneConfig]:
    """Let `mikasa-vla finetune` train nothing, and return the list of what it is asked for."""
    seen: list[FinetuneConfig] = []

    def fake(config: FinetuneConfig, **_: Any) -> Any:
        seen.append(config)
        return SimpleNamespace(out=Path("o"), checkpoint=Path("o/c"), step=1, is_finished=True)

    monkeypatch.setattr(finetune_module, "finetune", fake)
    return seen
