"""A checkpoint whose files do not belong together: one message and exit code 1, with every verb."""

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from lerobot.configs import PreTrainedConfig
from lerobot.processor import ProcessorStepRegistry

from tests.checkpoints.small_checkpoints import TASK, act_config, save, with_features
from vla_eval.checkpoints.loading import LoadOptions, config_class
from vla_eval.checkpoints.processors import register_steps
from vla_eval.checkpoints.verify import verify_checkpoint
from vla_eval.cli.main import main
from vla_eval.errors import VlaEvalError
from vla_eval.testing.tiny_models import tiny_resnet

CONFIG, BEFORE, AFTER = "config.json", "policy_preprocessor.json", "policy_postprocessor.json"
SHIPPED = Path(__file__).parents[2] / "checkpoints" / "memory_color3"
Damage = Callable[[Path], None]


def fields(**changes: Any) -> Damage:
    """Change fields of the configuration."""

    def damage(folder: Path) -> None:
        file = folder / CONFIG
        file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))

    return damage


def step(file: str, name: str, **config: Any) -> Damage:
    """Put a step of another family before the others."""

    def damage(folder: Path) -> None:
        data = json.loads((folder / file).read_text())
        data["steps"].insert(0, {"registry_name": name, "config": config})
        (folder / file).write_text(json.dumps(data))

    return damage


NETWORKS: Mapping[str, Damage] = {
    "heads that do not divide the width": fields(n_heads=7),
    "no heads": fields(n_heads=0),
    "a width below zero": fields(dim_model=-32),
    "a backbone that is a module": fields(vision_backbone="resnet"),
    "a backbone that is no network": fields(vision_backbone="resnet9"),
    "a backbone by another name": fields(vision_backbone="resnet18.__init__"),
    "an activation that is none": fields(feedforward_activation="tan"),
    "layers without end": fields(n_encoder_layers=10**9),
    "a width beyond all memory": fields(dim_model=2**62, n_heads=1),
    "an action without numbers": fields(output_features={"action": {"type": "ACTION", "shape": []}}),
}
PROCESSORS: Mapping[str, Damage] = {
    "a step that cuts out more than there is": step(
        BEFORE, "image_crop_resize_processor", crop_params_dict={"observation.images.base": [0, 0, 9000, 1]}
    ),
    "a new name for the state": step(
        BEFORE, "rename_observations_processor", rename_map={"observation.state": "observation.other"}
    ),
    "a new name for the action": step(AFTER, "rename_observations_processor", rename_map=7),
    "a step of GR00T": step(BEFORE, "groot_n1d7_unpack_v1"),
    "a step that is not registered": step(BEFORE, "one_of_tomorrow"),
}
with contextlib.suppress(VlaEvalError):
    config_class("none", where="")  # registers all
for _kind in PreTrainedConfig.get_known_choices():
    with contextlib.suppress(ImportError):  # a package that a family needs is not installed
        register_steps(PreTrainedConfig.get_choice_class(_kind))
REGISTERED = sorted(ProcessorStepRegistry.list())


@pytest.fixture(autouse=True)
def small() -> Iterator[None]:
    with tiny_resnet():
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with tiny_resnet():
        return save(with_features(act_config()), tmp_path_factory.mktemp("act") / "model")


@pytest.fixture
def damaged(whole: Path, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A copy with the damage that the test is parametrised with."""
    folder = tmp_path / "damaged"
    shutil.copytree(whole, folder)
    request.param(folder)
    return folder


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one message of a verb that has to refuse."""
    assert main(arguments) == 1
    said = capsys.readouterr().err
    assert "Traceback" not in said
    (message,) = [line for line in said.splitlines() if line.startswith("mikasa-vla: error: ")]
    return message


every_damage = pytest.mark.parametrize(
    "damaged", {**NETWORKS, **PROCESSORS}.values(), ids={**NETWORKS, **PROCESSORS}.keys(), indirect=True
)
every_network = pytest.mark.parametrize("damaged", NETWORKS.values(), ids=NETWORKS.keys(), indirect=True)


@every_damage
def test_verify_says_what_is_wrong(damaged: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert str(damaged) in refused(["checkpoint", "verify", str(damaged)], capsys)


@every_damage
def test_check_says_what_is_wrong(damaged: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(["check", str(damaged), "--task", TASK], capsys)


@every_network
def test_a_dry_run_says_what_is_wrong(
    damaged: Path, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    section = {"type": "act", "base_checkpoint": str(damaged), "steps": 2, "batch_size": 2}
    recipe = {"version": 1, "description": "x", "adapter": "lerobot", "finetune": section}
    file = tmp_path / "recipe.yaml"
    file.write_text(yaml.safe_dump(recipe))
    refused(["finetune", "--policy", str(file), "--dataset", str(recorded), "--dry-run"], capsys)


@pytest.mark.slow  # a worker that imports torch and lerobot
@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (fields(patch_px=7), "memory_color3"),
        (PROCESSORS["a step that is not registered"], "one_of_tomorrow"),
        (step(BEFORE, "groot_n1d7_unpack_v1"), "memory_color3"),
    ],
)
def test_eval_says_what_is_wrong(
    damage: Damage, says: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "memory_color3"
    shutil.copytree(SHIPPED, folder)
    damage(folder)
    arguments = ["--task", TASK, "--policy", str(folder), "--episodes", "1", "--workers", "1"]
    assert main(["eval", *arguments, "--set", "simulator=fake", "--out", str(tmp_path / "run")]) == 1
    said = capfd.readouterr().err
    assert says in said
    assert "Traceback" not in said


@pytest.mark.parametrize("file", [BEFORE, pytest.param(AFTER, marks=pytest.mark.slow)])
def test_a_step_of_any_family_is_taken_or_refused(whole: Path, tmp_path: Path, file: str) -> None:
    outcomes = set()
    for name in REGISTERED:
        folder = tmp_path / name
        shutil.copytree(whole, folder)
        step(file, name)(folder)
        try:
            verify_checkpoint(folder, LoadOptions(device="cpu"))
            outcomes.add("taken")
        except VlaEvalError:
            outcomes.add("refused")
    assert outcomes == {"taken", "refused"}


def test_the_checkpoint_is_whole_without_the_damage(whole: Path) -> None:
    with contextlib.redirect_stdout(None):
        assert main(["checkpoint", "verify", str(whole)]) == 0
