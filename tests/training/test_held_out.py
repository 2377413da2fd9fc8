"""Evaluation while a training goes on, and its metrics elsewhere: neither touches a weight."""

import dataclasses
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from tests.training import tiny_trainings
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.cli.main import main
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe, HeldOutConfig
from vla_eval.errors import MissingDependencyError, RecipeError, UnknownNameError
from vla_eval.evaluation.resolve import resolve
from vla_eval.storage.run_folder import read_run
from vla_eval.training import held_out as held_out_module
from vla_eval.training.dataset import training_dataset
from vla_eval.training.finetune import finetune
from vla_eval.training.held_out import check_held_out

pytestmark = pytest.mark.usefixtures("small_act")

TASK = "RememberColor3-v0"
TINY_ACT = {
    **{"chunk_size": 4, "n_action_steps": 4, "dim_model": 32, "n_heads": 2, "dim_feedforward": 32},
    **{"n_encoder_layers": 1, "n_vae_encoder_layers": 1, "latent_dim": 8, "dropout": 0.1},
}
SHORT = {"steps": 4, "batch_size": 2, "save_every_steps": 2, "log_every_steps": 1, "num_workers": 0}
ON_FAKE = HeldOutConfig(
    every_steps=2,
    episodes=3,
    simulator="fake",
    env={"horizon_steps": 8, "delay_steps": 1},
    workers=1,
    n_action_steps=2,
)


class Killed(BaseException):
    """Stands for kill -9: nothing of ours catches it."""


@pytest.fixture(autouse=True)
def cache_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def act(dataset: Path, out: Path, **changes: Any) -> FinetuneConfig:
    section = {**SHORT, "policy": TINY_ACT, **changes.pop("finetune", {})}
    common = {"policy": "act", "dataset": str(dataset), "out": str(out), "run_seed": 3, "device": "cpu"}
    return FinetuneConfig(**common, finetune=section, allow_unreplayed=True, **changes)


def same_weights(one: Path, other: Path) -> bool:
    tensors = [load_file(find_checkpoint(run) / "model.safetensors") for run in (one, other)]
    return tensors[0].keys() == tensors[1].keys() and all(
        torch.equal(tensor, tensors[1][name]) for name, tensor in tensors[0].items()
    )


def metrics(run: Path) -> list[tuple[str, Any]]:
    """Return what of each line does not depend on the clock."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [
        (f"eval {line['step']}", line["success_once"])
        if "held_out" in line
        else (f"{line['step']}", line["loss"])
        for line in lines
    ]


@pytest.fixture
def quick_evaluation(monkeypatch: pytest.MonkeyPatch) -> list[EvalConfig]:
    """Let evaluations run the random policy: what is claimed here is not the adapter's affair."""
    seen: list[EvalConfig] = []

    def quick(config: EvalConfig, **options: Any) -> Any:
        seen.append(config)
        return resolve(dataclasses.replace(config, policies=("random",)), **options)

    monkeypatch.setattr(held_out_module, "resolve", quick)
    return seen


@pytest.fixture
def straight(recorded: Path, tmp_path: Path, quick_evaluation: list[EvalConfig]) -> Path:
    """A run with evaluations that nothing has disturbed."""
    finetune(act(recorded, tmp_path / "straight", held_out=ON_FAKE))
    return tmp_path / "straight"


class TestEvaluation:
    @pytest.mark.usefixtures("small_act_in_workers")
    def test_the_checkpoint_is_evaluated_and_the_weights_are_those_of_a_run_without(
        self, recorded: Path, tmp_path: Path
    ) -> None:
        lines: list[str] = []
        last_only = dataclasses.replace(ON_FAKE, every_steps=4)
        finetune(act(recorded, tmp_path / "with", held_out=last_only), say=lines.append)
        finetune(act(recorded, tmp_path / "without"))

        assert same_weights(tmp_path / "with", tmp_path / "without")
        assert [name for name, _ in metrics(tmp_path / "with")] == ["1", "2", "3", "4", "eval 4"]
        assert metrics(tmp_path / "with")[:4] == metrics(tmp_path / "without")
        (folder,) = (tmp_path / "with" / "evaluations").iterdir()
        records = read_run(folder).records
        assert {(r.policy, r.seed, r.n_inferences) for r in records} == {
            ("with-000004", seed, 4) for seed in (900_000, 900_001, 900_002)
        }
        rate = sum(bool(r.success_once) for r in records) / 3
        assert metrics(tmp_path / "with")[-1] == ("eval 4", rate)
        assert any(line.startswith(f"step 4/4  {TASK}, held-out seeds: success") for line in lines)

    def test_a_training_that_was_killed_during_an_evaluation_goes_on_as_it_would_have(
        self,
        recorded: Path,
        straight: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        quick_evaluation: list[EvalConfig],
    ) -> None:
        broken = tmp_path / "broken"
        assert [name for name, _ in metrics(straight)] == ["1", "2", "eval 2", "3", "4", "eval 4"]

        def kill(folder: Path) -> Any:
            raise Killed

        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(held_out_module, "read_run", kill)
            finetune(act(recorded, broken, held_out=ON_FAKE))
        assert [name for name, _ in metrics(broken)] == ["1", "2"]
        finetune(act(recorded, broken, held_out=ON_FAKE))

        assert same_weights(straight, broken)
        assert metrics(broken) == metrics(straight)
        n_evaluations = len(quick_evaluation)
        finetune(act(recorded, broken, held_out=ON_FAKE))  # all is there
        assert len(quick_evaluation) == n_evaluations

    def test_an_evaluation_is_stopped_with_its_training_and_finished_by_the_next_call(
        self, recorded: Path, straight: Path, tmp_path: Path, quick_evaluation: list[EvalConfig]
    ) -> None:
        stopped, n_before = tmp_path / "stopped", len(quick_evaluation)
        asked = finetune(
            act(recorded, stopped, held_out=ON_FAKE), is_stopping=lambda: len(quick_evaluation) > n_before
        )
        assert (asked.is_finished, asked.step) == (False, 2)
        assert [name for name, _ in metrics(stopped)] == ["1", "2"]  # no figure of a part

        assert finetune(act(recorded, stopped, held_out=ON_FAKE)).is_finished
        assert same_weights(straight, stopped)
        assert metrics(stopped) == metrics(straight)

    def test_other_settings_evaluate_the_checkpoints_that_are_there_again(
        self, recorded: Path, tmp_path: Path, quick_evaluation: list[EvalConfig]
    ) -> None:
        finetune(act(recorded, tmp_path / "run", finetune={"steps": 2}, held_out=ON_FAKE))
        more = dataclasses.replace(ON_FAKE, episodes=4)
        finetune(act(recorded, tmp_path / "run", finetune={"steps": 2}, held_out=more))

        assert [config.episodes for config in quick_evaluation] == [3, 4]
        assert [name for name, _ in metrics(tmp_path / "run")] == ["1", "2", "eval 2", "eval 2"]


class TestSeeds:
    def check(self, dataset: Path, **fields: Any) -> str:
        settings = HeldOutConfig(**{"every_steps": 10, **fields})
        recipe = FinetuneRecipe(type="act", save_every_steps=5)
        return check_held_out(settings, recipe, training_dataset(dataset, allow_unreplayed=True))

    def test_seeds_of_their_own_are_taken_and_the_task_is_the_datasets(self, recorded: Path) -> None:
        assert self.check(recorded) == TASK
        assert self.check(recorded, seed_start=101, task="InterceptMedium-v0") == "InterceptMedium-v0"

    # Tables: 1 … 100. Demonstrations: 1000, 1001, 1003, 1004; tried and failed: 1002.
    @pytest.mark.parametrize(
        ("seed_start", "episodes", "message"),
        [
            (100, 1, r"1 of these seeds \(100 … 100\) are seeds that tables are made from"),
            (0, 3, r"2 of these seeds \(1 … 2\)"),
            (1002, 1, r"1 of these seeds \(1002 … 1002\) are seeds that were recorded from"),
            (990, 12, r"2 of these seeds \(1000 … 1001\)"),
        ],
    )
    def test_seeds_that_serve_something_else_are_refused(
        self, recorded: Path, seed_start: int, episodes: int, message: str
    ) -> None:
        with pytest.raises(RecipeError, match=message):
            self.check(recorded, seed_start=seed_start, episodes=episodes)

    def test_only_steps_with_a_checkpoint_can_be_evaluated(self, recorded: Path) -> None:
        with pytest.raises(RecipeError, match=r"every_steps is 7, expected a multiple of .* \(5\)"):
            self.check(recorded, every_steps=7)

    def test_a_mistyped_task_is_told_before_the_training(self, recorded: Path) -> None:
        with pytest.raises(UnknownNameError, match="Did you mean 'RememberColor3-v0'"):
            self.check(recorded, task="RemberColor3-v0")


class TestTrackers:
    def test_trackio_gets_the_lines_of_the_file_and_nothing_goes_to_standard_output(
        self,
        recorded: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        quick_evaluation: list[EvalConfig],
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        logged: list[tuple[int, Mapping[str, float]]] = []
        calls: list[Any] = []
        trackio: Any = ModuleType("trackio")

        def init(**options: Any) -> None:
            print("a dashboard")
            calls.append(options)

        trackio.init = init
        trackio.log = lambda values, step: logged.append((step, values))
        trackio.finish = lambda: calls.append("finish")
        monkeypatch.setitem(sys.modules, "trackio", trackio)

        section = {"steps": 2, "trackio_project": "memory"}
        finetune(act(recorded, tmp_path / "run", finetune=section, held_out=ON_FAKE))

        assert (calls[0]["project"], calls[0]["name"], calls[0]["resume"]) == ("memory", "run", "allow")
        assert calls[1:] == ["finish"]
        assert [step for step, _ in logged] == [1, 2, 2]
        lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
        assert [values.get("loss") for _, values in logged] == [line.get("loss") for line in lines]
        assert logged[2][1]["success_once"] == lines[2]["success_once"]
        assert capsys.readouterr().out == ""
        # A tracker is no part of what a run is compared by.
        finetune(act(recorded, tmp_path / "run", finetune={"steps": 2}, held_out=ON_FAKE))

    def test_a_tracker_that_is_not_installed_is_an_error_that_says_what_to_install(
        self, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "trackio", None)
        with pytest.raises(MissingDependencyError, match=r"pip install 'mikasa-vla-eval\[trackio\]'"):
            finetune(act(recorded, tmp_path / "run", finetune={"trackio_project": "memory"}))


def test_the_command_line_asks_for_evaluations(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = tiny_trainings.asked_for(monkeypatch)
    arguments = ["finetune", "--policy", "act", "--dataset", str(recorded)]
    assert main(arguments) == 0
    assert main([*arguments, "--held-out-every", "5000", "--held-out-episodes", "7"]) == 0
    assert [config.held_out for config in seen] == [None, HeldOutConfig(every_steps=5000, episodes=7)]
    assert main([*arguments, "--held-out-episodes", "7"]) == 1
    assert "every_steps" in capsys.readouterr().err
