"""Two processes that are killed go on with the samples and the losses of two that were not."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PROCESSES = ("-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2", "-m", "vla_eval.cli")
SETTINGS = {
    "save_every_steps": 7,  # an epoch has 7 steps: 55 frames, two batches of 4 each
    "log_every_steps": 1,
    "num_workers": 0,
    "policy.dim_model": 32,
    "policy.n_heads": 2,
    "policy.dim_feedforward": 32,
    "policy.n_encoder_layers": 1,
    "policy.n_vae_encoder_layers": 1,
    "policy.latent_dim": 8,
    "policy.chunk_size": 4,
    "policy.n_action_steps": 4,
    "policy.pretrained_backbone_weights": "null",
}


def command(dataset: Path, out: Path, *, steps: int = 16) -> list[str]:
    sets = [word for name, value in SETTINGS.items() for word in ("--set", f"{name}={value}")]
    flags = ("--allow-unreplayed", "--device", "cpu", "--steps", str(steps), "--batch-size", "4")
    return [
        *(sys.executable, *PROCESSES, "finetune", "--policy", "act", "--dataset", str(dataset)),
        *(*flags, *sets, "--out", str(out)),
    ]


def losses(run: Path) -> list[float]:
    file = run / "metrics.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    return [json.loads(line)["loss"] for line in lines]


@pytest.mark.slow
@pytest.mark.parametrize("at", [9, 15])
def test_killed_after_the_first_and_the_second_epoch(recorded: Path, tmp_path: Path, at: int) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1"}
    subprocess.run(command(recorded, tmp_path / "whole"), env=environment, check=True)
    whole = losses(tmp_path / "whole")
    run = tmp_path / "killed"
    process = subprocess.Popen(command(recorded, run), env=environment, start_new_session=True)
    while len(losses(run)) < at:
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    subprocess.run(command(recorded, run), env=environment, check=True)
    assert losses(run) == whole
    assert len(whole) == 16


@pytest.mark.slow
def test_a_training_that_is_extended_is_the_longer_one(recorded: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1"}
    for out, steps in (("whole", 12), ("longer", 9), ("longer", 12)):
        subprocess.run(command(recorded, tmp_path / out, steps=steps), env=environment, check=True)
    assert losses(tmp_path / "longer") == losses(tmp_path / "whole")
    record = json.loads((tmp_path / "longer/finetune.json").read_text())
    assert [(change["before"], change["at"]) for change in record["steps_changed"]] == [(9, 9)]
