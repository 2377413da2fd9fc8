"""A finished training that is started again, with the same number of steps or another one."""

import json
import re
import resource
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from lerobot.optim import schedulers

from tests.training import test_held_out, test_offline_rl_to_eval, test_sequence_to_eval, tiny_trainings
from tests.training.test_held_out import ON_FAKE, same_weights
from tests.training.tiny_trainings import act
from vla_eval.cli.main import main
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.errors import TrainingError
from vla_eval.models.openvla.configuration_openvla import StepDecaySchedulerConfig
from vla_eval.models.spatialvla.configuration_spatialvla import LinearDecaySchedulerConfig
from vla_eval.training.extension import first_other_rate
from vla_eval.training.finetune import finetune
from vla_eval.training.request import finished_run

pytestmark = pytest.mark.usefixtures("small_act")
quick_evaluation = test_held_out.quick_evaluation
offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own


def losses(run: Path) -> list[float]:
    return [json.loads(line)["loss"] for line in (run / "metrics.jsonl").read_text().splitlines()]


def with_cosine(dataset: Path, out: Path, **changes: Any) -> FinetuneConfig:
    """A cosine that has ended before the training does: more steps change nothing of it."""
    config = test_sequence_to_eval.tiny("rate", dataset, out, **changes)
    ended = {"scheduler_decay_steps": 2, "decision_share": 0.5, "erase_share": 0.5}
    policy = {**config.finetune["policy"], **ended, "erase_warmup_episodes": 20}  # a counter
    return replace(config, finetune={**config.finetune, "policy": policy})


def with_slow_weights(dataset: Path, out: Path, **changes: Any) -> FinetuneConfig:
    policy = {"scheduler_decay_steps": 2}
    return test_offline_rl_to_eval.tiny("iql", dataset, out, policy=policy, **changes)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind", [act, with_cosine, with_slow_weights])
def test_an_extended_training_is_the_longer_one_bit_for_bit(
    recorded: Path, tmp_path: Path, kind: Callable[..., FinetuneConfig]
) -> None:
    whole, longer = tmp_path / "whole", tmp_path / "longer"
    finetune(kind(recorded, whole, steps=5, save_every_steps=2))
    assert finetune(kind(recorded, longer, steps=3, save_every_steps=2)).step == 3

    assert finetune(kind(recorded, longer, steps=5, save_every_steps=2), command="the second").step == 5

    assert same_weights(whole, longer)
    assert losses(whole) == losses(longer)
    steps = {entry.name for entry in (longer / "train/checkpoints").iterdir()}
    assert steps == {"000002", "000003", "000004", "000005", "last"}  # the end of the first part stays
    (change,) = json.loads((longer / "finetune.json").read_text())["steps_changed"]
    assert (change["before"], change["at"], change["command"]) == (3, 3, "the second")
    assert finished_run(kind(recorded, longer, steps=5, save_every_steps=2)) is not None
    with pytest.raises(TrainingError, match=r"5 steps are done.*--steps 3 asks for fewer"):
        finetune(kind(recorded, longer, steps=3, save_every_steps=2))


def test_a_number_of_steps_that_was_a_slip_can_be_corrected(
    recorded: Path, tmp_path: Path, killed_at: Any
) -> None:
    whole, run = tmp_path / "whole", tmp_path / "run"
    finetune(act(recorded, whole, steps=5))
    with killed_at(3):
        finetune(act(recorded, run, steps=500))
    finetune(act(recorded, run, steps=5))
    assert same_weights(whole, run)
    assert losses(whole) == losses(run)


def test_another_schedule_is_refused_with_a_command_that_works(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def annealed(steps: int) -> FinetuneConfig:
        config = test_sequence_to_eval.tiny("rate", recorded, tmp_path / "run", steps=steps)
        policy = {**config.finetune["policy"], "scheduler_decay_steps": 1000}
        return replace(config, finetune={**config.finetune, "policy": policy})

    finetune(annealed(2))
    before = (tmp_path / "run/finetune.json").read_bytes()
    with pytest.raises(TrainingError, match="another from step 2 on") as refused:
        finetune(annealed(3))
    assert (tmp_path / "run/finetune.json").read_bytes() == before
    line = next(line for line in str(refused.value).splitlines() if line.startswith("  mikasa-vla"))
    assert main(shlex.split(line)[1:]) == 0
    assert capsys.readouterr().out.startswith(str(tmp_path / "run-2"))
    record = json.loads((tmp_path / "run-2/finetune.json").read_text())
    assert record["settings"]["finetune"]["steps"] == 1
    weights = tmp_path / "run/train/checkpoints/000002/pretrained_model"
    assert record["settings"]["finetune"]["base_checkpoint"] == str(weights)


COSINE = {"num_warmup_steps": 3, "num_decay_steps": 10, "peak_lr": 1.0, "decay_lr": 0.1}
SCHEDULES: dict[str, tuple[Any, int | None]] = {
    # What is compared: 20 steps with 22, 21 rates. A warm-up of n steps has the rates of steps 1 to n.
    "none": (None, None),
    "constant": (schedulers.ConstantWithWarmupSchedulerConfig(num_warmup_steps=5), None),
    "a cosine that ended": (schedulers.CosineDecayWithWarmupSchedulerConfig(**COSINE), None),
    "a cosine of 22 steps, made for 20": (  # the warm-up of 3 became one of 2
        schedulers.CosineDecayWithWarmupSchedulerConfig(**{**COSINE, "num_decay_steps": 22}),
        1,
    ),
    "down to the last step": (
        schedulers.CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=5),
        7,  # the cosine begins at 1 with step 6
    ),
    "diffusers, cosine": (schedulers.DiffuserSchedulerConfig(name="cosine", num_warmup_steps=5), 7),
    "diffusers, constant": (schedulers.DiffuserSchedulerConfig(name="constant", num_warmup_steps=5), None),
    "codebook first": (
        schedulers.VQBeTSchedulerConfig(num_warmup_steps=2, num_vqvae_training_steps=8),
        12,  # 8 constant, 2 of warm-up, 1 at the top
    ),
    "codebook alone": (
        schedulers.VQBeTSchedulerConfig(num_warmup_steps=2, num_vqvae_training_steps=30),
        None,
    ),
    "down once": (StepDecaySchedulerConfig(num_decay_steps=7, num_warmup_steps=2), None),
    "in a straight line": (LinearDecaySchedulerConfig(num_warmup_steps=4), 6),
}


@pytest.mark.parametrize("name", SCHEDULES)
def test_the_first_step_of_another_rate_is_found(name: str) -> None:
    preset, expected = SCHEDULES[name]
    policy = SimpleNamespace(
        get_scheduler_preset=lambda: preset, get_optimizer_preset=lambda: SimpleNamespace(lr=1e-3)
    )
    found = first_other_rate(policy, 20, 22, n_steps=21)
    assert (None if found is None else found.step) == expected


def test_every_schedule_of_lerobot_and_ours_is_among_them() -> None:
    tried = {type(preset) for preset, _ in SCHEDULES.values() if preset is not None}
    assert set(schedulers.LRSchedulerConfig.get_known_choices().values()) <= tried


NO_TORCH = """import sys
class NotHere:
    def find_spec(self, name, path, target=None):
        if name in ("torch", "lerobot", "pyarrow", "accelerate", "datasets"):
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, NotHere())
from vla_eval.cli.main import main
sys.exit(main(sys.argv[1:]))"""


@pytest.mark.slow
def test_a_finished_training_says_so_in_seconds_and_without_torch(recorded: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    flags = [*("finetune", "--policy", "act", "--dataset", str(recorded), "--allow-unreplayed")]
    flags += ["--device", "cpu", "--steps", "2", "--batch-size", "2", "--out", str(run)]
    flags += ["--set", "num_workers=0"]
    small = {**tiny_trainings.TINY_ACT, "dropout": 0.1}
    flags += [word for name, value in small.items() for word in ("--set", f"policy.{name}={value}")]
    assert main(flags) == 0

    def again(*more: str) -> "subprocess.CompletedProcess[str]":
        command = [sys.executable, "-c", NO_TORCH, *flags, *more]
        return subprocess.run(command, capture_output=True, text=True)

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = again()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert (done.returncode, "finished" in done.stderr) == (0, True), done.stderr
    # Of the processor: other tests run beside this one.
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 5
    assert done.stdout.strip() == str(run / "train/checkpoints/last/pretrained_model")
    assert again("--set", "wandb_project=x").returncode == 0  # no part of what is trained
    for other in (["--batch-size", "3"], ["--run-seed", "1"], ["--steps", "3"]):
        assert "ModuleNotFoundError" in again(*other).stderr  # what differs is looked at in full
    for file, change in (("recording.json", ("tiny", "other")), ("recording.json", ("other", "tiny"))):
        recording = recorded / "meta/mikasa" / file
        recording.write_text(recording.read_text().replace(*change))
        assert ("finished" in again().stderr) is (change[1] == "tiny")


def test_an_evaluation_that_is_missing_is_not_finished(
    recorded: Path, tmp_path: Path, quick_evaluation: object
) -> None:
    config = act(recorded, tmp_path / "run")
    finetune(config)
    assert finished_run(config) is not None
    evaluated = replace(config, held_out=ON_FAKE)
    assert finished_run(evaluated) is None
    finetune(evaluated)
    assert finished_run(evaluated) is not None
    with pytest.raises(TrainingError, match=re.escape("finetune.batch_size: 2 -> 3")):
        finetune(act(recorded, tmp_path / "run", batch_size=3))


DAMAGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "a number of changes": lambda record: record.update(steps_changed=3),
    "changes that are numbers": lambda record: record.update(steps_changed=[3]),
    "a number in quotes": lambda record: record.update(steps_changed=[{"before": "3"}]),
    "no settings": lambda record: record.update(settings=[]),
    "no recipe": lambda record: record["settings"].update(finetune=1),
    "steps in quotes": lambda record: record["settings"]["finetune"].update(steps="1"),
    "another version": lambda record: record.update(format_version=2),
}


@pytest.mark.sampled(7)
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_record_is_one_message(recorded: Path, tmp_path: Path, damage: str) -> None:
    file = tmp_path / "run/finetune.json"
    finetune(act(recorded, tmp_path / "run", steps=1))
    record = json.loads(file.read_text())
    DAMAGES[damage](record)
    file.write_text(json.dumps(record))
    with pytest.raises(TrainingError, match=r"finetune\.json: (expected|format)"):
        finetune(act(recorded, tmp_path / "run", steps=2))
