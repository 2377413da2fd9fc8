"""Tiny VLAs with memory learn a delayed cue that the same ones without it cannot."""

from pathlib import Path
from typing import Any

import pytest

from tests.models.vla_memory.tiny_vlas import fields_of, tiny
from tests.training import tiny_trainings
from tests.training.remembered_toy import choices, trained, write_demonstrations
from vla_eval.data.opening import OpenDataset
from vla_eval.testing.tiny_models import write_tiny_tokenizer

offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own
STEPS, N_EPISODES = 500, 24
NONE: dict[str, Any] = {}
LAST = {"memory_places": 2, "memory_rule": "last", "memory_stride": 3}
KEYFRAMES = {"memory_places": 2, "memory_rule": "keyframes"}
TOKENS = {"memory_tokens": 4, "token_stride": 4, "token_segments": 6}


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> OpenDataset:
    return write_demonstrations(tmp_path_factory.mktemp("toy") / "seen_cue", n_episodes=12)


def choices_of(
    family: str,
    memory: dict[str, Any],
    demonstrations: OpenDataset,
    folder: Path,
    patched: pytest.MonkeyPatch,
) -> list[bool | None]:
    """Train a tiny VLA of this family, and return its choices in `N_EPISODES` new episodes."""
    recipe = folder / "tiny.yaml"
    recipe.write_text(
        f"version: 1\ndescription: tiny\nadapter: lerobot\nfinetune: {{type: mikasa_{family}}}\n"
    )
    schedule = {"scheduler_warmup_steps": 20, "scheduler_decay_steps": STEPS, "scheduler_decay_lr": 1e-4}
    policy = {**fields_of(family, folder), **schedule, "optimizer_lr": 1e-3, "tokenizer_max_length": 8}
    section = {"steps": STEPS, "batch_size": 16, "save_every_steps": STEPS, "log_every_steps": 20}
    if family == "smolvla":  # its language model has random weights: what is frozen sees nothing
        policy |= {"train_expert_only": False, "freeze_vision_encoder": False}
    else:
        section["tokenizer"] = str(write_tiny_tokenizer(folder / "tokenizer"))
    with tiny(family):
        run = trained(
            *(demonstrations, recipe, folder / "run", patched),
            policy={**policy, **memory},
            num_workers=0,
            **section,
        )
        return choices(run, n_episodes=N_EPISODES)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "memory"),
    [
        *(("pi0", memory) for memory in (LAST, KEYFRAMES, TOKENS)),
        ("smolvla", KEYFRAMES),
    ],
    ids=["pi0-last", "pi0-keyframes", "pi0-tokens", "smolvla-keyframes"],
)
def test_with_memory_it_learns_a_delayed_cue(
    family: str,
    memory: dict[str, Any],
    demonstrations: OpenDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chosen = choices_of(family, memory, demonstrations, tmp_path, monkeypatch)
    assert chosen.count(True) >= 22


@pytest.mark.slow
@pytest.mark.parametrize("family", ["pi0", "smolvla"])
def test_without_memory_it_moves_and_guesses(
    family: str, demonstrations: OpenDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = choices_of(family, NONE, demonstrations, tmp_path, monkeypatch)
    # Two sides: of 24 episodes, guessing is right in 19 or more once in 300 times.
    assert chosen.count(None) <= 2 and chosen.count(True) < 19
