"""What the bench of loaders measures with, and a whole run of it."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml
from torch.utils.data import DataLoader, SequentialSampler

from vla_eval.bench import loader
from vla_eval.bench.loader import run_loader_bench
from vla_eval.cli.main import main
from vla_eval.errors import ConformanceError, RecipeError, VlaEvalError

RECIPES = Path(__file__).parents[2] / "policies"


@pytest.fixture
def small(tmp_path: Path) -> Callable[[str], str]:
    """Write a recipe again with two samples in a batch, loaded in one process; return its file."""

    def write(name: str) -> str:
        recipe = yaml.safe_load((RECIPES / f"{name}.yaml").read_text())
        recipe["finetune"] |= {"batch_size": 2, "num_workers": 0}
        file = tmp_path / f"{name}.yaml"
        file.write_text(json.dumps(recipe))
        return str(file)

    return write


class TestWhatIsMeasured:
    def test_both_loaders_serve_the_recipes_batches_and_an_episode_where_it_is_trained_on_episodes(
        self, recorded: Path, small: Callable[[str], str]
    ) -> None:
        policies = [small("act"), small("recurrent")]
        act, recurrent = run_loader_bench(recorded, policies, n_batches=1, repeats=1).rows

        assert (act.batch_size, act.n_frames, act.n_processes) == (2, 2, 0)  # two cameras
        assert recurrent.n_frames >= 2 * 15  # the longest episode has 15 frames
        for row in (act, recurrent):
            assert row.ratio == row.ours_per_second / row.lerobot_per_second
            assert row.ours_per_second > 0
            assert row.lerobot_per_second > 0

    def test_samples_that_are_not_lerobots_end_the_bench(
        self, recorded: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def darker(self, camera, rows):  # type: ignore[no-untyped-def]
            return image(self, camera, rows) // 2

        image = loader.dataset_of.__globals__["DecodedFramesDataset"]._image
        monkeypatch.setattr(loader.dataset_of.__globals__["DecodedFramesDataset"], "_image", darker)

        with pytest.raises(ConformanceError, match=r"policy 'act', sample \d+: 'observation\.images\.base'"):
            run_loader_bench(recorded, ["act"], n_batches=1, repeats=1)

    @pytest.mark.parametrize(
        ("policy", "found"), [("oracle", "no section `finetune`"), ("smolvla_frames", "earlier")]
    )
    def test_a_recipe_whose_samples_cannot_be_compared_is_named(
        self, recorded: Path, policy: str, found: str
    ) -> None:
        with pytest.raises(RecipeError, match=found):
            run_loader_bench(recorded, [policy], n_batches=1, repeats=1)

    def test_the_first_batches_are_not_counted(self, monkeypatch: pytest.MonkeyPatch) -> None:
        ticks = iter([100.0, 104.0])  # read after the first batches, and at the end
        monkeypatch.setattr("vla_eval.bench.loader.time.perf_counter", lambda: next(ticks))
        samples = [{"action": torch.zeros(1)} for _ in range(12)]
        batches = DataLoader(samples, batch_size=3, sampler=SequentialSampler(samples))  # type: ignore[arg-type]

        assert loader._rate(batches, 2, 2) == (3 + 3) / 4.0


class TestCommand:
    def test_it_prints_a_row_for_each_recipe(
        self, recorded: Path, small: Callable[[str], str], capsys: pytest.CaptureFixture[str]
    ) -> None:
        flags = ["--loader", str(recorded), "--policy", small("act"), "--batches", "1", "--repeats", "1"]
        assert main(["bench", *flags]) == 0

        out = capsys.readouterr().out
        (row,) = [line for line in out.splitlines() if "act" in line]
        assert row.count("|") == 9
        assert "bit-equal" in out

    def test_an_unknown_recipe_is_refused_before_a_dataset_is_made(self, tmp_path: Path) -> None:
        assert main(["bench", "--loader", "--policy", "nowhere"]) == 1
        with pytest.raises(VlaEvalError):
            run_loader_bench(tmp_path, ["act"], n_batches=1, repeats=1)
