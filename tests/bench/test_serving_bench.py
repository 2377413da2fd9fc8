"""What the bench of serving measures with, and a whole run of it."""

from pathlib import Path

import numpy as np
import pytest
import torch

from vla_eval.bench.serving import run_serving_bench
from vla_eval.bench.serving_processes import Asker, context, make_in_process
from vla_eval.cli.main import main
from vla_eval.testing.looking_policy import write_recipe
from vla_eval.testing.serving_policies import (
    StillPolicy,
    make_small_transformer,
    make_still,
    write_small_transformer,
)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small") / "small"
    write_small_transformer(folder)
    return folder


class TestWhatIsMeasured:
    def test_the_small_transformer_has_a_few_million_parameters_and_draws_none_of_them_from_the_clock(
        self, small: Path, tmp_path: Path
    ) -> None:
        n_parameters = write_small_transformer(tmp_path / "again")

        assert 1e6 < n_parameters < 1e7
        weights = [(folder / "model.safetensors").read_bytes() for folder in (small, tmp_path / "again")]
        assert weights[0] == weights[1]

    @pytest.mark.parametrize("precision", ["float32", "bfloat16"])
    def test_it_computes_in_the_precision_that_is_named(self, small: Path, precision: str) -> None:
        policy = make_small_transformer(context("p", n_rows=1), checkpoint=str(small), dtype=precision)
        found = {parameter.dtype for parameter in policy._loaded.policy.parameters()}

        assert getattr(torch, precision) in found
        assert np.isfinite(Asker(policy).ask()).all()

    def test_an_asker_shows_its_policy_what_it_declares_and_counts_the_steps(self) -> None:
        seen = []

        class Watched(StillPolicy):
            def act(self, window):  # type: ignore[no-untyped-def]
                seen.append(window.last)
                return super().act(window)

        asker = Asker(Watched("still"), seed=3)
        assert asker.ask().shape == (8, 7)
        asker.ask()

        assert [frame.step for frame in seen] == [0, 1]
        assert {name: image.shape for name, image in seen[0].images.items()} == {
            "base_camera": (128, 128, 3),
            "hand_camera": (128, 128, 3),
        }
        assert not np.array_equal(seen[0].images["base_camera"], seen[1].images["base_camera"])

    def test_a_recipe_of_the_bench_makes_its_policy(self, tmp_path: Path) -> None:
        recipe = write_recipe(tmp_path / "still.yaml", make_still)

        assert isinstance(make_in_process(recipe, n_rows=1), StillPolicy)


@pytest.mark.slow
class TestRun:
    def test_one_run_measures_all(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["bench", "--serve", "--sessions", "1", "2", "--seconds", "1"]) == 0

        out = capsys.readouterr().out
        assert "small transformer, 2.8 M parameters" in out
        assert "ms added" in out
        assert "| 1 | " in out and "| 2 | " in out
        assert "float32: actions of a pass with 2 rows" in out and "bfloat16: actions" in out

    def test_a_row_has_no_more_copies_than_there_are_cores(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("os.sched_getaffinity", lambda _: {0})

        report = run_serving_bench("memory_color3", sessions=[2], seconds=0.5)

        (row,) = report.rows
        assert (row.n_sessions, row.n_copies) == (2, 1)
        assert row.served.per_second > 0 and row.copies.per_second > 0
        assert [one.precision for one in report.rounding] == ["as its recipe says"]
        assert report.rounding[0].largest < 1e-5
