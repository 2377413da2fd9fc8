"""Several evaluations one after another, as tables, audits and probes run them."""

import argparse
from pathlib import Path
from typing import Any

import pytest

from vla_eval.cli.shared import evaluations
from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import FolderInUseError
from vla_eval.evaluation.evaluate import EvaluationSummary
from vla_eval.evaluation.resolve import ResolvedEvaluation
from vla_eval.workers.local import LOCAL

CONFIG = EvalConfig(name="one", tasks=("RememberColor3-v0",), policies=("oracle",))


@pytest.fixture
def in_use(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """Folder -> how often it will be found in use; written folders are at the end, in their order."""
    tries: dict[str, int] = {}

    def evaluate_one(resolved: ResolvedEvaluation, *_: Any, **__: Any) -> EvaluationSummary:
        out = resolved.out
        if tries.get(out.name, 0) > 0:
            tries[out.name] -= 1
            raise FolderInUseError(f"{out}: another process (pid 1) is writing into this run folder.")
        tries.pop(out.name, None)
        tries[out.name] = 0
        return EvaluationSummary(out=out, n_episodes=1, n_open=0, n_errors=0, was_stopped=False)

    monkeypatch.setattr(evaluations, "evaluate_one", evaluate_one)
    return tries


def run(*names: str) -> None:
    evaluations.evaluate_each(
        [(Path(name), CONFIG) for name in names], argparse.Namespace(shard=None), backend=LOCAL
    )


def test_a_folder_that_another_process_writes_comes_after_all_others(
    in_use: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    in_use["controls"] = 1

    run("controls", "rate", "dt")

    assert list(in_use) == ["rate", "dt", "controls"]
    assert capsys.readouterr().err == "controls: another process is writing into it; it comes last.\n"


def test_a_folder_that_is_still_in_use_at_the_end_is_an_error_after_all_others_are_written(
    in_use: dict[str, int],
) -> None:
    in_use["controls"] = 3

    with pytest.raises(FolderInUseError, match="pid 1"):
        run("controls", "rate")

    assert in_use == {"controls": 1, "rate": 0}
