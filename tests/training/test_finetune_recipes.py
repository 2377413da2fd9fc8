"""What a fine-tuning is told: recipes, datasets, bases and options; what cannot be trained is refused."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.training import tiny_trainings
from tests.training.fitted_policies import policy_config
from tests.training.tiny_trainings import act, context, pi0
from vla_eval.checkpoints.loading import make_empty_policy
from vla_eval.cli.main import main
from vla_eval.config.files import list_recipes, load_recipe
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.config.policy import PolicyRecipe
from vla_eval.data.manifest import REPLAY_FILE, ReplayReport, manifest_sha256, write_entry
from vla_eval.errors import CheckpointError, DatasetError, RecipeError, SpecMismatchError, TrainingError
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.testing.tiny_models import TINY_POLICY, tiny_paligemma
from vla_eval.training.cost.estimate import describe_model
from vla_eval.training.dataset import training_dataset
from vla_eval.training.finetune import finetune
from vla_eval.training.policy_config import masks_padding, used_frames
from vla_eval.training.request import load_finetune_recipe

pytestmark = pytest.mark.usefixtures("small_act")
tokenizer = tiny_trainings.tokenizer
offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own


class TestPaddedActions:
    def configuration(self, config: FinetuneConfig, dataset: Path) -> Any:
        recipe = load_finetune_recipe(config).value
        return policy_config(recipe, training_dataset(dataset, allow_unreplayed=True), device="cpu")

    def test_act_masks_them_so_that_every_frame_begins_a_chunk(self, recorded: Path, tmp_path: Path) -> None:
        config = self.configuration(act(recorded, tmp_path / "o"), recorded)
        dataset = training_dataset(recorded, allow_unreplayed=True)
        assert masks_padding(config)
        assert used_frames(config, dataset) == (55, 55)  # 13 + 14 + 15 + 13

    @pytest.mark.parametrize("name", ["memory", "memoryless", "recurrent", "octo_tiny", "spatialvla_tiny"])
    def test_so_do_our_own_but_for_openvla(self, name: str, recorded: Path, tmp_path: Path) -> None:
        config = FinetuneConfig(policy=name, dataset=str(recorded), out=str(tmp_path / "o"))
        dataset = training_dataset(recorded, allow_unreplayed=True)
        assert used_frames(self.configuration(config, recorded), dataset) == (55, 55)

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

    def test_a_folder_that_holds_one_dataset_stands_for_it(self, recorded: Path, tmp_path: Path) -> None:
        shutil.copytree(recorded, tmp_path / "demos" / "one")
        assert training_dataset(tmp_path / "demos", allow_unreplayed=True).root == tmp_path / "demos" / "one"

    def test_a_folder_that_holds_several_datasets_is_answered_by_their_names(
        self, recorded: Path, tmp_path: Path
    ) -> None:
        for name in ("one", "two"):
            shutil.copytree(recorded, tmp_path / "demos" / name)
        with pytest.raises(DatasetError, match=r"expected one dataset, found 2: one, two\. Name one"):
            training_dataset(tmp_path / "demos", allow_unreplayed=True)

    def test_a_changed_file_is_refused(self, recorded: Path) -> None:
        (recorded / "meta/stats.json").write_text("{}")
        with pytest.raises(DatasetError, match=r"meta/stats\.json"):
            training_dataset(recorded, allow_unreplayed=True)

    def test_a_mistyped_field_of_the_policy_gets_an_answer(self, recorded: Path, tmp_path: Path) -> None:
        with pytest.raises(Exception, match=r"no field 'chunk_sizes'\. Did you mean 'chunk_size'"):
            finetune(act(recorded, tmp_path / "o", policy={"chunk_sizes": 4}))

    @pytest.mark.parametrize(
        ("transforms", "message"),
        [
            (
                {"tfs": {"hue": {"type": "ColourJitter"}}},
                r"image_transforms: Transform 'ColourJitter'",
            ),
            ({"max_transforms": 1}, r"image_transforms: .*max_transforms"),
        ],
    )
    def test_image_transforms_that_lerobot_does_not_have_are_refused(
        self, recorded: Path, tmp_path: Path, transforms: dict[str, Any], message: str
    ) -> None:
        with pytest.raises(RecipeError, match=f"(?s){message}"):
            finetune(act(recorded, tmp_path / "o", image_transforms=transforms))
        assert not (tmp_path / "o").exists()

    def test_a_type_that_could_not_be_evaluated_is_not_trained(self, recorded: Path, tmp_path: Path) -> None:
        config = act(recorded, tmp_path / "o")
        with pytest.raises(CheckpointError, match=r"'lingbot_va' cannot be evaluated"):
            finetune(replace(config, finetune={**config.finetune, "type": "lingbot_va"}))
        assert not (tmp_path / "o").exists()

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
        config = FinetuneConfig(policy=name, dataset=str(recorded), finetune=changes)
        made = policy_config(load_finetune_recipe(config).value, dataset, device="cpu")
        assert list(made.image_features) == ["observation.images.base", "observation.images.wrist"]
        checked += 1
    assert checked >= 8


@pytest.mark.parametrize("family", ["pi0", "pi05"])
def test_the_expert_alone_is_trained_and_the_language_model_is_not(recorded: Path, family: str) -> None:
    changes = {"base_checkpoint": None, "rename_cameras": {}, "policy": TINY_POLICY}
    config = FinetuneConfig(policy=f"{family}_expert", dataset=str(recorded), finetune=changes)
    dataset = training_dataset(recorded, allow_unreplayed=True)
    with tiny_paligemma(family):
        model = make_empty_policy(policy_config(load_finetune_recipe(config).value, dataset, device="cpu"))
    names = dict(model.named_parameters())
    language_model = {name for name in names if name.startswith("model.paligemma_with_expert.paligemma.")}
    assert language_model
    assert {name for name in names if not names[name].requires_grad} == language_model


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
    seen = tiny_trainings.asked_for(monkeypatch)
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
