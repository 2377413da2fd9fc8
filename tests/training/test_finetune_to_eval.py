"""From a dataset to a table by the two commands, for tiny π0, π0.5 and SmolVLA, without a network."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from vla_eval.checkpoints.files import checkpoint_sha256, find_checkpoint
from vla_eval.cli.main import main
from vla_eval.evaluation import evaluate as evaluate_module
from vla_eval.storage.run_folder import read_run
from vla_eval.testing.tiny_models import (
    TINY_POLICY,
    TINY_RUNNER,
    tiny_paligemma,
    write_tiny_smolvlm,
    write_tiny_tokenizer,
)

TASK = "RememberColor3-v0"
SHORT = {"steps": 2, "batch_size": 2, "save_every_steps": 2, "log_every_steps": 1, "num_workers": 0}
FAKE = ["--set", "simulator=fake", "--set", "env.horizon_steps=6", "--set", "env.delay_steps=0"]


@pytest.fixture(autouse=True)
def offline_with_a_cache_of_its_own(
    no_network: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def tiny_recipes(folder: Path) -> dict[str, dict[str, Any]]:
    """Return family -> `finetune` section."""
    tokenizer = str(write_tiny_tokenizer(folder / "tokenizer"))
    paligemma = {**TINY_POLICY, "gradient_checkpointing": False, "scheduler_decay_steps": 4}
    smolvla = {
        **{"vlm_model_name": str(write_tiny_smolvlm(folder / "vlm")), "load_vlm_weights": False},
        **{"num_vlm_layers": 2, "resize_imgs_with_padding": [64, 64], "num_steps": 2},
        **{"chunk_size": 4, "n_action_steps": 4},
    }
    return {
        "pi0": {"type": "pi0", "tokenizer": tokenizer, "policy": paligemma},
        "pi05": {"type": "pi05", "tokenizer": tokenizer, "policy": paligemma},
        "smolvla": {"type": "smolvla", "policy": smolvla},
    }


@pytest.mark.parametrize(
    "families", [["smolvla"], pytest.param(["pi0", "pi05", "smolvla"], marks=pytest.mark.slow)], ids="-".join
)
def test_tiny_ones_go_from_a_dataset_to_a_table_in_worker_processes(
    families: list[str],
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    runs: dict[str, Path] = {}
    with tiny_paligemma("pi0"), tiny_paligemma("pi05"):
        recipes = tiny_recipes(tmp_path)
        for family in families:
            section = recipes[family]
            recipe = tmp_path / f"tiny_{family}.yaml"
            text = {
                "version": 1,
                "description": "tiny",
                "adapter": "lerobot",
                "finetune": {**SHORT, **section},
            }
            recipe.write_text(yaml.safe_dump(text))
            runs[family] = tmp_path / family
            arguments = ["--policy", str(recipe), "--dataset", str(recorded), "--device", "cpu"]
            code = main(["finetune", *arguments, "--allow-unreplayed", "--out", str(runs[family])])
            assert code == 0
            assert Path(capsys.readouterr().out.strip()) == find_checkpoint(runs[family])

    monkeypatch.setattr(evaluate_module, "RUNNER", TINY_RUNNER)
    out = tmp_path / "evaluation"
    policies = ["--policy", *map(str, runs.values())]
    # 1001 is a seed of the demonstrations, 1002 is not: the expert failed there.
    arguments = ["--task", TASK, *policies, "--n-action-steps", "2", "4", "--workers", "1"]
    arguments += ["--seed-start", "1001", "--episodes", "2"]
    assert main(["eval", *arguments, *FAKE, "--out", str(out)]) == 0

    run = read_run(out)
    # 6 control steps: 3 inferences with 2 actions each; with 4, the second chunk is cut by the horizon.
    assert {(r.policy, r.n_action_steps, r.n_inferences) for r in run.records} == {
        (f"{family}-000002", n_action_steps, n_inferences)
        for family in runs
        for n_action_steps, n_inferences in ((2, 3), (4, 2))
    }
    for family, folder in runs.items():
        described = json.loads((folder / "finetune.json").read_text())
        dataset = described["settings"]["dataset"]
        assert run.description.recipes[f"datasets/{dataset['name']}"] == dataset["sha256"]
        assert run.description.recipes[f"checkpoints/{family}-000002"] == checkpoint_sha256(folder)
    printed = capsys.readouterr()
    assert "smolvla-000002" in printed.out
    warning = (
        "smolvla-000002 was trained on demonstrations of 1 of the 2 seeds it is evaluated on in "
        f"{TASK} (1001)"
    )
    assert f"warning: {warning}" in printed.err  # before the first episode
    assert f"- {warning}" in printed.out  # below the table
    assert "smolvla-000002" in json.loads((out / "run.json").read_text())["training_seeds"]
    assert main(["eval", *arguments, *FAKE, "--dry-run"]) == 0
    assert f"warning: {warning}" in capsys.readouterr().out
