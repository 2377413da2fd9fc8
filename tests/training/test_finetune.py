"""Fine-tuning end to end on a tiny dataset, offline: train, kill, go on, load, evaluate."""

import json
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch
from urllib.error import URLError

import numpy as np
import pytest
import torch
import torchvision
from safetensors.torch import load_file, save_file

from tests.training import tiny_trainings
from tests.training.tiny_trainings import SHORT, TASK, act, context, pi0
from vla_eval.checkpoints.files import WEIGHTS_FILE, TrainingFacts, find_checkpoint, read_facts, write_facts
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.core import EpisodeStart
from vla_eval.data import exact_statistics
from vla_eval.data.frames.decoded_frames import DecodedFramesDataset
from vla_eval.envs.factory import make_env
from vla_eval.errors import CheckpointError, TrainingError
from vla_eval.features import STATE_NAMES
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.policies.recipe import load_policy_recipe
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.seeding import SeedRange
from vla_eval.testing.tiny_models import make_tiny, tiny_paligemma, write_tiny_smolvlm
from vla_eval.training.finetune import finetune

pytestmark = pytest.mark.usefixtures("small_act")
tokenizer = tiny_trainings.tokenizer
offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own

DARK = {"type": "ColorJitter", "kwargs": {"brightness": [0.0, 0.0]}}
KilledAt = Callable[[int], AbstractContextManager[None]]


def weights(run: Path) -> dict[str, torch.Tensor]:
    return dict(load_file(find_checkpoint(run) / "model.safetensors"))


def metrics(run: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def run_an_episode(policy: Any) -> int:
    env = make_env(EnvSettings(task=TASK, simulator="fake", cameras=("base_camera", "hand_camera")))
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="touch it", horizon_steps=6)
    (record,) = rollout(env, policy, [start], RolloutSettings(chunking=ChunkingSpec(n_action_steps=2)))
    assert record.n_inferences is not None
    return record.n_inferences


class TestRuns:
    def test_a_person_is_told_how_it_goes_and_a_file_all_that_lerobot_says(
        self, recorded: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        lines: list[str] = []
        finetune(act(recorded, tmp_path / "run"), say=lines.append)
        assert any(line.startswith("step 4/") and line.endswith(" min left") for line in lines)
        screen = "".join(capfd.readouterr())
        assert "optimizer" not in screen  # lerobot's whole configuration
        assert "Training:" not in screen  # a bar, which only a terminal can draw
        log = (tmp_path / "run" / "train.log").read_text()
        assert "'optimizer'" in log
        assert "End of training" in log

    def test_dimensions_that_hardly_move_are_named_and_not_blown_up(
        self, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        facts = (recorded / "meta/stats.json").read_text()
        exact = np.array(json.loads(facts)["observation.state"]["std"])
        least = float(np.median(exact))  # so that half of the dimensions hardly move
        monkeypatch.setattr(exact_statistics, "RESOLUTION", least)
        lines: list[str] = []

        finetune(act(recorded, tmp_path / "run", steps=2), say=lines.append)

        (line,) = (line for line in lines if line.startswith("hardly move in these demonstrations"))
        for name, std in zip(STATE_NAMES["eef"], exact, strict=True):
            assert (f" {name} {std:.2g}" in line) == (std < least)
        for processor in ("policy_preprocessor", "policy_postprocessor"):
            (file,) = find_checkpoint(tmp_path / "run").glob(f"{processor}*.safetensors")
            assert load_file(file)["observation.state.std"].tolist() == pytest.approx(exact.clip(min=least))
        assert (recorded / "meta/stats.json").read_text() == facts

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
        # The episodes of `recorded` are of these; the expert failed at 1002.
        assert facts.seeds == {TASK: (SeedRange(first=1000, last=1001), SeedRange(first=1003, last=1004))}
        recipe = load_policy_recipe(str(straight))
        assert (recipe.name, recipe.value.default_n_action_steps) == ("straight-000004", 4)
        policy = make_lerobot(context(), checkpoint=str(straight))
        assert run_an_episode(policy) == 3  # 6 steps, 2 actions each

        again = finetune(act(recorded, straight))  # finished: nothing to do
        assert again.checkpoint == find_checkpoint(straight)
        with pytest.raises(TrainingError, match=r"finetune\.batch_size: 2 -> 3"):
            finetune(act(recorded, straight, batch_size=3))

    @pytest.mark.parametrize("transforms", [None, {"tfs": {"dark": DARK}}])
    def test_pictures_are_changed_as_the_recipe_says(
        self,
        recorded: Path,
        tmp_path: Path,
        transforms: dict[str, Any] | None,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        brightest: list[float] = []
        served = DecodedFramesDataset.__getitem__

        def watched(dataset: Any, index: int) -> Any:
            sample = served(dataset, index)
            brightest.append(float(sample["observation.images.base"].max()))
            return sample

        monkeypatch.setattr(DecodedFramesDataset, "__getitem__", watched)
        monkeypatch.delattr(DecodedFramesDataset, "__getitems__", raising=False)
        finetune(act(recorded, tmp_path / "run", image_transforms=transforms))
        assert brightest
        assert (max(brightest) == 0) == (transforms is not None)

    def test_a_tiny_pi0_goes_the_whole_way_and_resumes_exactly(
        self, recorded: Path, tmp_path: Path, tokenizer: Path, killed_at: KilledAt
    ) -> None:
        straight, broken = tmp_path / "straight", tmp_path / "broken"
        lines: list[str] = []
        with tiny_paligemma("pi0"):
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
        assert run_an_episode(make_tiny(context(), checkpoint=str(straight))) == 3

    def test_lora_trains_adapters_on_a_base_and_is_evaluated_with_it(
        self, recorded: Path, tmp_path: Path, tokenizer: Path, killed_at: KilledAt
    ) -> None:
        base, lora = tmp_path / "base", tmp_path / "lora"
        changes: dict[str, Any] = {"base_checkpoint": str(base), "lora": {"rank": 4}}
        lines: list[str] = []
        with tiny_paligemma("pi0"):
            finetune(pi0(recorded, base, tokenizer, steps=2))
            facts = read_facts(find_checkpoint(base))
            assert facts is not None
            earlier = SeedRange(first=1, last=9)  # as if the base had been trained on another dataset
            write_facts(find_checkpoint(base), replace(facts, seeds={TASK: (earlier,)}))
            with killed_at(3):
                finetune(pi0(recorded, lora, tokenizer, **changes))
            finetune(pi0(recorded, lora, tokenizer, **changes), say=lines.append)
        folder = find_checkpoint(lora)
        assert (folder / "adapter_model.safetensors").is_file()
        assert not (folder / "model.safetensors").is_file()
        facts = read_facts(folder)
        assert facts is not None and facts.seeds is not None
        assert facts.seeds[TASK] == (
            earlier,
            SeedRange(first=1000, last=1001),
            SeedRange(first=1003, last=1004),
        )
        trained = next(line for line in lines if line.startswith("trained:"))
        n_trained, n_all = (int(word.replace(",", "")) for word in trained.split() if word[0].isdigit())
        assert 0 < n_trained < n_all / 4
        assert run_an_episode(make_tiny(context(), checkpoint=str(lora))) == 3

        (base / "train").rename(base / "moved")
        with pytest.raises(CheckpointError, match=r"Name its folder with `base_checkpoint`"):
            make_tiny(context(), checkpoint=str(lora))

    @pytest.mark.parametrize(
        ("family", "projections"),
        [
            ("pi0", {"state_proj", "action_time_mlp_in", "action_time_mlp_out"}),
            ("pi05", {"time_mlp_in", "time_mlp_out"}),
        ],
    )
    def test_lora_reaches_the_experts_attention_and_all_its_projections(
        self, recorded: Path, tmp_path: Path, tokenizer: Path, family: str, projections: set[str]
    ) -> None:
        """lerobot 0.6.1 looks for π0.5's projections of time under π0's names, and leaves them frozen."""
        recipe = recorded.parent / "tiny_pi0.yaml"
        recipe.write_text(recipe.read_text().replace("type: pi0", f"type: {family}"))
        base, lora = tmp_path / "base", tmp_path / "lora"
        with tiny_paligemma(family):
            finetune(pi0(recorded, base, tokenizer, steps=2))
            finetune(pi0(recorded, lora, tokenizer, steps=2, base_checkpoint=str(base), lora={"rank": 2}))
        names = load_file(find_checkpoint(lora) / "adapter_model.safetensors")
        modules = {name.partition(".lora_")[0].removeprefix("base_model.model.model.") for name in names}
        attention = {name for name in modules if re.search(r"gemma_expert\..*\.self_attn\.[qv]_proj$", name)}
        assert attention
        assert modules - attention == {"action_in_proj", "action_out_proj", *projections}

    def test_code_that_a_base_names_as_a_processor_is_not_run(
        self, recorded: Path, tmp_path: Path, tokenizer: Path
    ) -> None:
        base, trace = tmp_path / "base", tmp_path / "it-ran"
        with tiny_paligemma("pi0"):
            finetune(pi0(recorded, base, tokenizer, steps=2))
            file = find_checkpoint(base) / "policy_preprocessor.json"
            data = json.loads(file.read_text())
            data["steps"].append({"class": "os.system", "config": {"command": f"touch {trace}"}})
            file.write_text(json.dumps(data))
            with pytest.raises(CheckpointError, match=r"names the code 'os\.system'"):
                finetune(pi0(recorded, tmp_path / "next", tokenizer, base_checkpoint=str(base)))
        assert not trace.exists()
        assert not (tmp_path / "next").exists()  # a mistake leaves no empty run folder

    def test_a_base_of_before_lerobots_processors_or_without_theirs_is_refused_before_a_run_begins(
        self, recorded: Path, tmp_path: Path
    ) -> None:
        base = tmp_path / "base"
        finetune(act(recorded, base, steps=2))
        folder = find_checkpoint(base)
        after = folder / "policy_postprocessor.json"
        content = after.read_text()
        after.unlink()
        lines: list[str] = []

        with pytest.raises(CheckpointError, match=r"policy_postprocessor\.json: there is no such file"):
            finetune(act(recorded, tmp_path / "next", base_checkpoint=str(base)), say=lines.append)
        after.write_text(content)
        tensors = weights(base)
        save_file({**tensors, "normalize_inputs.buffer_action.mean": torch.zeros(7)}, folder / WEIGHTS_FILE)
        with pytest.raises(CheckpointError, match="migrate_policy_normalization"):
            finetune(act(recorded, tmp_path / "next", base_checkpoint=str(base)), say=lines.append)

        assert not lines and not (tmp_path / "next").exists()

    def test_a_base_that_lacks_a_tensor_is_not_trained_on(
        self, recorded: Path, tmp_path: Path, tokenizer: Path
    ) -> None:
        base = tmp_path / "base"
        with tiny_paligemma("pi0"):
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
        policy = make_tiny(context(), checkpoint=str(run))
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

    @pytest.mark.parametrize("n_obs_steps", [1, 2])
    def test_a_small_diffusion_policy_goes_the_whole_way(
        self, recorded: Path, tmp_path: Path, n_obs_steps: int
    ) -> None:
        """It reads its frames in time, a single one too, so the window of the adapter is tried."""
        run = tmp_path / "run"
        network = {
            "down_dims": [16, 32],
            "n_groups": 4,
            "diffusion_step_embed_dim": 16,
            "num_train_timesteps": 4,
        }
        frames = {"n_obs_steps": n_obs_steps, "horizon": 8, "n_action_steps": 4}
        policy = {**frames, "num_inference_steps": 2, **network}
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

    def test_weights_that_cannot_be_downloaded_are_named_and_how_to_do_without(
        self, recorded: Path, tmp_path: Path
    ) -> None:
        def offline(**_: Any) -> torch.nn.Module:
            raise URLError("Name or service not known")

        with (
            patch.object(torchvision.models, "resnet18", offline),
            pytest.raises(TrainingError, match=r"not known.*pretrained_backbone_weights=null"),
        ):
            finetune(act(recorded, tmp_path / "run"))


def small_resnet(*, weights: Any) -> torch.nn.Module:
    """Stand for ResNet-18 in Diffusion Policy, which leaves out the last two layers of it."""
    assert weights is None, "a recipe from scratch would download weights"
    return torch.nn.Sequential(torch.nn.Conv2d(3, 8, 32, 32), torch.nn.Identity(), torch.nn.Identity())
