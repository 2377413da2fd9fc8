"""Fine-tuning end to end on a tiny dataset, offline: train, kill, go on, load, evaluate."""

import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import torch
import torchvision
from safetensors.torch import load_file

from vla_eval.cli.main import main
from vla_eval.core import EpisodeStart
from vla_eval.data.manifest import REPLAY_FILE, ReplayReport, write_entry
from vla_eval.data.replay_report import manifest_sha256
from vla_eval.envs.factory import make_env
from vla_eval.envs.settings import EnvSettings
from vla_eval.errors import CheckpointError, DatasetError, RecipeError, SpecMismatchError, TrainingError
from vla_eval.policies.checkpoint import TrainingFacts, find_checkpoint, read_facts
from vla_eval.policies.chunking import ChunkingSpec
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot import make_lerobot
from vla_eval.policies.recipe import load_policy_recipe
from vla_eval.recipes import PolicyRecipe, list_recipes, load_recipe
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.training import finetune as finetune_module
from vla_eval.training.dataset import training_dataset
from vla_eval.training.description import describe_model
from vla_eval.training.finetune import finetune, load_finetune_recipe
from vla_eval.training.policy_config import masks_padding, policy_config, used_frames
from vla_eval.training.recipe import FinetuneConfig
from vla_eval.training.tiny_models import (
    TINY_POLICY,
    make_tiny_pi0,
    tiny_paligemma,
    write_tiny_smolvlm,
    write_tiny_tokenizer,
)

pytestmark = pytest.mark.usefixtures("small_act")
KilledAt = Callable[[int], AbstractContextManager[None]]

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


@pytest.fixture
def tokenizer(tmp_path: Path, recorded: Path) -> Path:
    (recorded.parent / "tiny_pi0.yaml").write_text(
        "version: 1\ndescription: tiny\nadapter: lerobot\nfinetune: {type: pi0}\n"
    )
    return write_tiny_tokenizer(tmp_path / "tokenizer")


def weights(run: Path) -> dict[str, torch.Tensor]:
    return dict(load_file(find_checkpoint(run) / "model.safetensors"))


def metrics(run: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def context() -> PolicyContext:
    env: Any = make_env(EnvSettings(task=TASK, simulator="fake"))
    return PolicyContext(name="p", env=env.spec, chunking=ChunkingSpec(n_action_steps=2), n_candidates=3)


def run_an_episode(policy: Any) -> int:
    env = make_env(EnvSettings(task=TASK, simulator="fake", cameras=("base_camera", "hand_camera")))
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="touch it", horizon_steps=6)
    (record,) = rollout(env, policy, [start], RolloutSettings(chunking=ChunkingSpec(n_action_steps=2)))
    assert record.n_inferences is not None
    return record.n_inferences


class TestRuns:
    def test_a_run_that_was_killed_ends_with_the_very_weights_of_one_that_was_not(
        self, recorded: Path, tmp_path: Path, killed_at: KilledAt
    ) -> None:
        straight, broken = tmp_path / "straight", tmp_path / "broken"
        lines: list[str] = []
        finetune(act(recorded, straight), say=lines.append)
        with killed_at(3):
            finetune(act(recorded, broken))
        assert [line["step"] for line in metrics(broken)] == [1, 2, 3]
        summary = finetune(act(recorded, broken))
        one, other = weights(straight), weights(broken)
        assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)
        assert [line["step"] for line in metrics(broken)] == [1, 2, 3, 4]
        assert [line["loss"] for line in metrics(broken)] == [line["loss"] for line in metrics(straight)]
        assert summary.checkpoint.parent.name == "000004" or summary.checkpoint.parent.name == "last"
        assert any("parameters (100.0%)" in line for line in lines)

        facts = read_facts(find_checkpoint(straight))
        described = json.loads((straight / "finetune.json").read_text())
        assert isinstance(facts, TrainingFacts)
        assert facts.dataset_sha256 == described["settings"]["dataset"]["sha256"]
        assert (facts.task, facts.state, facts.fps, facts.run_seed) == (TASK, "eef", 20.0, 3)
        recipe = load_policy_recipe(str(straight))
        assert (recipe.name, recipe.value.default_n_action_steps) == ("straight-000004", 4)
        policy = make_lerobot(context(), checkpoint=str(straight))
        assert run_an_episode(policy) == 3  # 6 steps, 2 actions each

        again = finetune(act(recorded, straight))  # finished: nothing to do
        assert again.checkpoint == find_checkpoint(straight)
        with pytest.raises(TrainingError, match=r"finetune\.batch_size: 2 -> 3"):
            finetune(act(recorded, straight, batch_size=3))

    def test_a_tiny_pi0_goes_the_whole_way_and_resumes_exactly(
        self, recorded: Path, tmp_path: Path, tokenizer: Path, killed_at: KilledAt
    ) -> None:
        straight, broken = tmp_path / "straight", tmp_path / "broken"
        lines: list[str] = []
        with tiny_paligemma():
            finetune(pi0(recorded, straight, tokenizer), say=lines.append)
            with killed_at(3):
                finetune(pi0(recorded, broken, tokenizer))
            finetune(pi0(recorded, broken, tokenizer))
        one, other = weights(straight), weights(broken)
        assert all(torch.equal(one[key], other[key]) for key in one)
        assert (find_checkpoint(straight) / "tokenizer" / "tokenizer.json").is_file()
        # 55 frames in 4 episodes; chunks of 4 must end within: the last 3 frames of each begin none.
        assert any("43 of 55 frames" in line for line in lines)
        tokenizer.rename(tmp_path / "gone")  # the checkpoint has its own
        assert run_an_episode(make_tiny_pi0(context(), checkpoint=str(straight))) == 3

    def test_lora_trains_adapters_on_a_base_and_is_evaluated_with_it(
        self, recorded: Path, tmp_path: Path, tokenizer: Path, killed_at: KilledAt
    ) -> None:
        base, lora = tmp_path / "base", tmp_path / "lora"
        changes: dict[str, Any] = {"base_checkpoint": str(base), "lora": {"rank": 4}}
        lines: list[str] = []
        with tiny_paligemma():
            finetune(pi0(recorded, base, tokenizer, steps=2))
            with killed_at(3):
                finetune(pi0(recorded, lora, tokenizer, **changes))
            finetune(pi0(recorded, lora, tokenizer, **changes), say=lines.append)
        folder = find_checkpoint(lora)
        assert (folder / "adapter_model.safetensors").is_file()
        assert not (folder / "model.safetensors").is_file()
        trained = next(line for line in lines if line.startswith("trained:"))
        n_trained, n_all = (int(word.replace(",", "")) for word in trained.split() if word[0].isdigit())
        assert 0 < n_trained < n_all / 4
        assert run_an_episode(make_tiny_pi0(context(), checkpoint=str(lora))) == 3

        (base / "train").rename(base / "moved")
        with pytest.raises(CheckpointError, match=r"Name its folder with `base_checkpoint`"):
            make_tiny_pi0(context(), checkpoint=str(lora))

    def test_a_base_that_lacks_a_tensor_is_not_trained_on(
        self, recorded: Path, tmp_path: Path, tokenizer: Path
    ) -> None:
        from safetensors.torch import save_file

        base = tmp_path / "base"
        with tiny_paligemma():
            finetune(pi0(recorded, base, tokenizer, steps=2))
            file = find_checkpoint(base) / "model.safetensors"
            tensors = load_file(file)
            del tensors["model.action_out_proj.weight"]
            save_file(tensors, file)
            with pytest.raises(CheckpointError, match=r"1 missing: model\.action_out_proj\.weight"):
                finetune(pi0(recorded, tmp_path / "next", tokenizer, base_checkpoint=str(base)))

    def test_a_tiny_pi05_goes_the_whole_way(self, recorded: Path, tmp_path: Path, tokenizer: Path) -> None:
        recipe = recorded.parent / "tiny_pi0.yaml"
        recipe.write_text(recipe.read_text().replace("type: pi0", "type: pi05"))
        run = tmp_path / "run"
        with tiny_paligemma("pi05"):
            finetune(pi0(recorded, run, tokenizer, steps=2))
        policy = make_tiny_pi0(context(), family="pi05", checkpoint=str(run))
        assert run_an_episode(policy) == 3

    def test_a_tiny_smolvla_goes_the_whole_way(self, recorded: Path, tmp_path: Path) -> None:
        recipe = recorded.parent / "tiny_smolvla.yaml"
        recipe.write_text("version: 1\ndescription: tiny\nadapter: lerobot\nfinetune: {type: smolvla}\n")
        run = tmp_path / "run"
        policy = {
            **{"vlm_model_name": str(write_tiny_smolvlm(tmp_path / "vlm")), "load_vlm_weights": False},
            **{"num_vlm_layers": 2, "resize_imgs_with_padding": [64, 64], "num_steps": 2},
            **{"chunk_size": 4, "n_action_steps": 4},
        }
        config = FinetuneConfig(
            policy=str(recipe),
            dataset=str(recorded),
            out=str(run),
            finetune={**SHORT, "steps": 2, "policy": policy},
            device="cpu",
            allow_unreplayed=True,
        )
        finetune(config)
        assert run_an_episode(make_lerobot(context(), checkpoint=str(run))) == 3

    def test_a_small_diffusion_policy_goes_the_whole_way(self, recorded: Path, tmp_path: Path) -> None:
        """It reads two frames, so the window of the adapter is tried, too."""
        run = tmp_path / "run"
        network = {
            "down_dims": [16, 32],
            "n_groups": 4,
            "diffusion_step_embed_dim": 16,
            "num_train_timesteps": 4,
        }
        policy = {"horizon": 8, "n_action_steps": 4, "num_inference_steps": 2, **network}
        config = FinetuneConfig(
            policy="diffusion",
            dataset=str(recorded),
            out=str(run),
            finetune={**SHORT, "steps": 2, "policy": policy},
            device="cpu",
            allow_unreplayed=True,
        )
        with patch.object(torchvision.models, "resnet18", small_resnet):
            finetune(config)
            assert run_an_episode(make_lerobot(context(), checkpoint=str(run))) == 3


def small_resnet(**_: Any) -> torch.nn.Module:
    """Stand for ResNet-18 in Diffusion Policy, which leaves out the last two layers of it."""
    return torch.nn.Sequential(torch.nn.Conv2d(3, 8, 32, 32), torch.nn.Identity(), torch.nn.Identity())


class TestPaddedActions:
    def configuration(self, config: FinetuneConfig, dataset: Path) -> Any:
        recipe = load_finetune_recipe(config).value
        return policy_config(recipe, training_dataset(dataset, allow_unreplayed=True), device="cpu")

    def test_act_masks_them_so_that_every_frame_begins_a_chunk(self, recorded: Path, tmp_path: Path) -> None:
        config = self.configuration(act(recorded, tmp_path / "o"), recorded)
        dataset = training_dataset(recorded, allow_unreplayed=True)
        assert masks_padding(config)
        assert used_frames(config, dataset) == (55, 55)  # 13 + 14 + 15 + 13

    def test_pi0_gets_no_chunk_with_a_padded_action(
        self, recorded: Path, tmp_path: Path, tokenizer: Path
    ) -> None:
        from lerobot.datasets import EpisodeAwareSampler

        config = self.configuration(pi0(recorded, tmp_path / "o", tokenizer), recorded)
        dataset = training_dataset(recorded, allow_unreplayed=True)
        assert not masks_padding(config)
        starts, ends = dataset.meta.episodes["dataset_from_index"], dataset.meta.episodes["dataset_to_index"]
        # As lerobot's loop makes it: `drop_n_last_frames=getattr(active_cfg, "drop_n_last_frames", 0)`.
        sampler = EpisodeAwareSampler(starts, ends, drop_n_last_frames=config.drop_n_last_frames)
        drawn = sorted(sampler)
        assert len(drawn) == used_frames(config, dataset).n_used == 55 - 4 * 3
        last_frames = {end - 1 for end in ends}
        for first in drawn:
            inner = set(range(first, first + 3))  # all but the chunk's last action
            assert not inner & last_frames

    def test_chunks_longer_than_all_episodes_are_an_error(
        self, recorded: Path, tmp_path: Path, tokenizer: Path
    ) -> None:
        policy = {**TINY_POLICY, "chunk_size": 16}
        with pytest.raises(SpecMismatchError, match=r"episodes of more than 15 frames, found at most 15"):
            finetune(pi0(recorded, tmp_path / "o", tokenizer, policy=policy))


class TestRefusals:
    def test_an_unreplayed_dataset_is_refused_with_the_way_out(self, recorded: Path) -> None:
        with pytest.raises(DatasetError, match=r"no replay has confirmed .* mikasa-vla replay"):
            training_dataset(recorded, allow_unreplayed=False)

    @pytest.mark.parametrize("passed", [True, False])
    def test_the_replays_verdict_decides(self, recorded: Path, passed: bool) -> None:
        report = ReplayReport(
            passed=passed,
            n_episodes=4,
            n_total=4,
            pixels=False,
            lowest_psnr_db={},
            states_compared="bit-equal",
            mismatches=() if passed else ("episode 2: other states",),
            manifest_sha256=manifest_sha256(recorded),
        )
        write_entry(recorded / REPLAY_FILE, report)
        if passed:
            assert training_dataset(recorded, allow_unreplayed=False).was_replayed
        else:  # also with the waiver: it waives ignorance, not a mismatch
            with pytest.raises(DatasetError, match=r"episode 2: other states"):
                training_dataset(recorded, allow_unreplayed=True)

    def test_a_changed_file_is_refused(self, recorded: Path) -> None:
        (recorded / "meta/stats.json").write_text("{}")
        with pytest.raises(DatasetError, match=r"meta/stats\.json"):
            training_dataset(recorded, allow_unreplayed=True)

    def test_a_mistyped_field_of_the_policy_gets_an_answer(self, recorded: Path, tmp_path: Path) -> None:
        with pytest.raises(Exception, match=r"no field 'chunk_sizes'\. Did you mean 'chunk_size'"):
            finetune(act(recorded, tmp_path / "o", policy={"chunk_sizes": 4}))

    def test_a_policy_with_nothing_to_train_is_refused(self, recorded: Path) -> None:
        with pytest.raises(RecipeError, match=r"oracle\.yaml has no section `finetune`"):
            finetune(FinetuneConfig(policy="oracle", dataset=str(recorded)))

    @pytest.mark.parametrize(("policy", "kind"), [("act", "act"), ("octo_tiny", "mikasa_octo")])
    def test_lora_has_to_know_its_layers(
        self, recorded: Path, tmp_path: Path, policy: str, kind: str
    ) -> None:
        config = FinetuneConfig(
            policy=policy,
            dataset=str(recorded),
            out=str(tmp_path / "o"),
            finetune={"lora": {"rank": 2}, "base_checkpoint": str(tmp_path)},
            device="cpu",
            allow_unreplayed=True,
        )
        with pytest.raises(RecipeError, match=rf"target_modules is not set, and '{kind}' does not say"):
            finetune(config)
        assert not (tmp_path / "o").exists()

    def test_a_missing_base_says_where_it_was_expected(self, recorded: Path, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match=r"checkpoints/pi0_base: expected a LeRobot checkpoint"):
            finetune(
                FinetuneConfig(
                    policy="pi0", dataset=str(recorded), out=str(tmp_path / "o"), allow_unreplayed=True
                )
            )

    def test_a_folder_of_somebody_else_is_left_alone(self, recorded: Path, tmp_path: Path) -> None:
        (tmp_path / "thesis.tex").touch()
        with pytest.raises(TrainingError, match=r"holds other files"):
            finetune(act(recorded, tmp_path))

    def test_an_untrained_recipe_cannot_be_evaluated(self) -> None:
        with pytest.raises(CheckpointError, match=r"mikasa-vla finetune --policy p"):
            make_lerobot(context())


def test_every_shipped_recipe_is_one_that_lerobot_accepts(recorded: Path, tmp_path: Path) -> None:
    dataset = training_dataset(recorded, allow_unreplayed=True)
    checked = 0
    for name in list_recipes("policies"):
        if load_recipe("policies", name, PolicyRecipe).value.finetune is None:
            continue
        # Without the base, which is not on this machine; its cameras' names go with it.
        changes: dict[str, Any] = {"base_checkpoint": None, "rename_cameras": {}, "lora": None}
        if name == "spatialvla_kept_grid":  # what it keeps is the base's
            changes["policy"] = {"action_grid": "refitted"}
        config = FinetuneConfig(policy=name, dataset=str(recorded), finetune=changes)
        made = policy_config(load_finetune_recipe(config).value, dataset, device="cpu")
        assert list(made.image_features) == ["observation.images.base", "observation.images.wrist"]
        checked += 1
    assert checked >= 8


def test_memory_is_weights_gradients_and_two_moments() -> None:
    model = torch.nn.Sequential(torch.nn.Linear(10, 10), torch.nn.Linear(10, 1))
    model[0].requires_grad_(False)
    described = describe_model(model)
    assert (described.n_trained, described.n_parameters) == (11, 121)
    assert described.weights_bytes == 121 * 4  # float32
    assert described.training_bytes == 11 * 4 * 3  # gradient and AdamW's two moments


def test_the_command_line_sets_fields_of_the_recipe(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[FinetuneConfig] = []

    def fake(config: FinetuneConfig, **_: Any) -> Any:
        seen.append(config)
        return finetune_module.FinetuneSummary(out=Path("o"), checkpoint=Path("o/c"))

    monkeypatch.setattr(finetune_module, "finetune", fake)
    arguments = ["--policy", "act", "--dataset", str(recorded), "--steps", "7", "--run-seed", "2"]
    assert main(["finetune", *arguments, "--set", "policy.chunk_size=8"]) == 0
    assert capsys.readouterr().out == "o/c\n"
    (config,) = seen
    assert config.finetune == {"steps": 7, "policy": {"chunk_size": 8}}
    assert load_finetune_recipe(config).value.policy["optimizer_lr"] == 1e-5  # the recipe's others stay
    assert main(["finetune", "--policy", "act"]) == 1
    assert "--dataset is missing" in capsys.readouterr().err
    assert main(["finetune", *arguments, "--set", "stepps=1"]) == 1
    assert "Did you mean 'steps'" in capsys.readouterr().err
