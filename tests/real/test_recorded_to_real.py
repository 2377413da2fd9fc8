"""From demonstrations to the arm: recorded, checked, trained on and run, with no name converted by hand."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
import yaml

from tests.cli.every_verb import command_line, environment_of
from vla_eval.checkpoints.files import find_checkpoint, read_facts
from vla_eval.cli.main import main
from vla_eval.data.facts import ArmFacts
from vla_eval.data.opening import open_dataset
from vla_eval.storage.run_folder import read_run
from vla_eval.testing.tiny_models import TINY_POLICY, tiny_paligemma, write_tiny_tokenizer

RECORD = (
    "real record --robot simulated_so100 --teleop scripted --operator scripted --episodes 2 --out {W}/data"
)
TINY = (
    "--set policy.dim_model=32 --set policy.n_heads=2 --set policy.dim_feedforward=32 --set "
    "policy.n_encoder_layers=1 --set policy.n_vae_encoder_layers=1 --set policy.latent_dim=8 --set "
    "save_every_steps=2"
)


def done(line: str, folder: Path) -> str:
    found = subprocess.run(
        command_line(line, folder), cwd=folder, env=environment_of(folder), capture_output=True, text=True
    )
    assert found.returncode == 0, found.stderr
    return found.stdout


def numbers_of(root: Path, task: str) -> list[list[float]]:
    columns = open_dataset(root / task).columns
    return [columns[key].tolist() for key in ("action", "observation.state", "episode_index")]


@pytest.mark.slow
def test_a_policy_that_is_trained_on_a_recording_runs_on_the_arm(tmp_path: Path) -> None:
    asked = f"{RECORD} --stage CubesThrownIn CubesShuffled"
    shards = tmp_path / "data" / "recording" / "real_twin" / "CubesShuffled-v0" / "shards"
    with subprocess.Popen(
        command_line(f"{asked} --rehearse cable@2 key@4", tmp_path),
        cwd=tmp_path,
        env=environment_of(tmp_path),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        while not any(path.suffix != ".draft" for path in shards.glob("shard-*")):
            assert process.poll() is None
            time.sleep(0.1)
        os.kill(process.pid, signal.SIGKILL)
    printed = done(asked, tmp_path)
    assert "6 episodes" in printed

    # As without faults and a kill: an episode is a function of its trial.
    whole = tmp_path / "whole"
    done(asked.replace("{W}/data", "{W}/whole"), tmp_path)
    for task in ("real_twin/CubesThrownIn-v0", "real_twin/CubesShuffled-v0"):
        assert numbers_of(tmp_path / "data", task) == numbers_of(whole, task)

    dataset = tmp_path / "data" / "real_twin" / "CubesShuffled-v0"
    facts = open_dataset(dataset).facts
    assert isinstance(facts, ArmFacts) and facts.leader == "scripted"
    assert {(one.cue_steps, one.delay_steps) for one in facts.episodes} == {(21, 40)}
    assert all(one.touched[-1] == one.color for one in facts.episodes)
    assert "demonstrations of real_twin/CubesShuffled-v0" in done(f"dataset check {dataset}", tmp_path)

    trains = f"finetune --policy act --dataset {dataset} --steps 2 --batch-size 2 --device cpu"
    done(f"{trains} --out {{W}}/act {TINY}", tmp_path)
    trained = read_facts(find_checkpoint(tmp_path / "act"))
    assert trained is not None and (trained.control_mode, trained.state) == ("motors", "motors")
    real = "real --robot simulated_so100 --policy act={W}/act oracle --stage CubesShuffled --episodes 1"
    done(f"{real} --out {{W}}/run", tmp_path)
    # Each in the control mode of its own: the expert plans in angles of the arm's model.
    outcomes = {(one.policy, one.outcome) for one in read_run(tmp_path / "run").records}
    assert ("oracle", "success") in outcomes and "error" not in {outcome for _, outcome in outcomes}


@pytest.mark.slow
def test_a_tiny_pi05_that_is_trained_on_a_recording_runs_in_all_stages(
    tmp_path: Path, no_network: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    arm = ["--robot", "simulated_so100", "--episodes", "1"]
    assert main(["real", "record", *arm, "--stage", "CubeVisible", "--out", str(tmp_path / "data")]) == 0
    recipe = tmp_path / "tiny_pi05.yaml"
    section = {
        "type": "pi05",
        "tokenizer": str(write_tiny_tokenizer(tmp_path / "tokenizer")),
        "policy": {**TINY_POLICY, "gradient_checkpointing": False, "scheduler_decay_steps": 4},
        **{"steps": 2, "batch_size": 2, "save_every_steps": 2, "num_workers": 0},
    }
    text = {"version": 1, "description": "tiny", "adapter": "lerobot", "finetune": section}
    recipe.write_text(yaml.safe_dump(text))
    dataset, trained = tmp_path / "data" / "real_twin" / "CubeVisible-v0", str(tmp_path / "pi05")

    with tiny_paligemma("pi05"):
        words = ["--policy", str(recipe), "--dataset", str(dataset), "--device", "cpu", "--out", trained]
        assert main(["finetune", *words]) == 0
        assert main(["real", *arm, "--policy", trained, "--out", str(tmp_path / "run"), "--paper"]) == 0

    records = read_run(tmp_path / "run").records
    assert len(records) == 9
    assert "error" not in {one.outcome for one in records}
    assert min(one.n_inferences for one in records) > 1
