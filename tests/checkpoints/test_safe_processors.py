"""A processor's step is checked before anything that a checkpoint names is imported or called."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.processor import DataProcessorPipeline, IdentityProcessorStep, ProcessorStepRegistry
from safetensors.torch import save_file

from vla_eval.checkpoints.safe_processors import load_processor, processors_through_the_door
from vla_eval.errors import CheckpointError

PACKAGE = "lerobot_policy_payload"


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    """What a payload writes if it runs."""
    return tmp_path / "it-ran"


@pytest.fixture
def payload(tmp_path: Path, trace: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that runs when it is imported, under names that begin like allowed ones."""
    site = tmp_path / "site"
    code = f"open({str(trace)!r}, 'w').close()\n"
    for package in ("lerobotevil", "vla_evalevil", PACKAGE):
        (site / package).mkdir(parents=True)
        for name in ("__init__.py", "processor_x.py"):
            (site / package / name).write_text(code)
    monkeypatch.syspath_prepend(str(site))
    return site / "lerobotevil" / "processor_x.py"


def write(folder: Path, *steps: Any) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / "policy_preprocessor.json"
    path.write_text(json.dumps({"name": "policy_preprocessor", "steps": list(steps)}))
    return path


def load(path: Path, **overrides: dict[str, Any]) -> Any:
    return load_processor(path, overrides=overrides)


NAMES = (
    # the three that ran in the attack
    ("lerobot.envs.utils._load_module_from_path", {"path": "PAYLOAD"}),
    ("vla_eval.cli.main.main", {"argv": ["list", "--help"]}),
    ("lerobot.utils.utils.init_logging", {"log_file": "TRACE"}),
    # that begin like an allowed one, or would have to be imported to be looked at
    ("lerobotevil.processor_x.Step", {}),
    ("vla_evalevil.processor_x.Step", {}),
    (f"{PACKAGE}.processor_x.Step", {}),
    ("os.system", {"command": "touch TRACE"}),
    ("payload.Step", {}),
    # in an allowed module, and no step of a policy
    ("lerobot.processor.pipeline.hf_hub_download", {"repo_id": "x", "filename": "y"}),
    ("lerobot.processor.pipeline.DataProcessorPipeline", {}),
    ("lerobot.processor.pipeline.ProcessorStep", {}),
    ("lerobot.processor.pipeline.ProcessorStepRegistry", {}),
    ("lerobot.processor.pipeline.json.load", {}),
    ("lerobot.processor.normalize_processor.NormalizerProcessorStep.from_config", {}),
    ("lerobot.processor.hil_processor.RewardClassifierProcessorStep", {"pretrained_path": "x"}),
    ("lerobot.processor.pipeline.__class__", {}),
    ("lerobot.processor.nothing.Step", {}),
    ("lerobot.processor.pipeline.Nothing", {}),
    ("lerobot.policies.act.modeling_act.ACTPolicy", {}),
    ("lerobot.policies.act.processor_act.make_act_pre_post_processors", {}),
    (".processor.Step", {}),
    ("lerobot..processor.Step", {}),
    ("Step", {}),
)


class TestNames:
    @pytest.mark.parametrize(("name", "config"), NAMES, ids=[name for name, _ in NAMES])
    def test_what_is_no_processor_step_is_refused_before_it_is_called(
        self, name: str, config: dict[str, Any], tmp_path: Path, payload: Path, trace: Path
    ) -> None:
        text = json.dumps(config).replace("PAYLOAD", str(payload)).replace("TRACE", str(trace))
        path = write(tmp_path / "model", {"class": name, "config": json.loads(text)})
        before = set(sys.modules)
        with pytest.raises(CheckpointError) as caught:
            load(path)
        assert not trace.exists()
        assert not any(name.endswith(".processor_x") for name in set(sys.modules) - before)
        message = str(caught.value)
        assert f"{path}: step 1" in message
        assert f"'{name}'" in message
        assert "It is not run" in message

    def test_no_step_is_made_if_a_later_one_is_refused(
        self, tmp_path: Path, trace: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        class Writes(IdentityProcessorStep):  # type: ignore[misc]  # lerobot is untyped
            def __init__(self) -> None:
                trace.touch()

        monkeypatch.setitem(ProcessorStepRegistry._registry, "writes", Writes)
        path = write(tmp_path / "model", {"registry_name": "writes"}, {"class": "os.system"})
        with pytest.raises(CheckpointError, match=r"step 2: names the code 'os\.system'"):
            load(path)
        assert not trace.exists()

    def test_a_registered_function_is_refused(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(ProcessorStepRegistry._registry, "sly", print)
        with pytest.raises(CheckpointError, match=r"names the code 'sly'.*not run"):
            load(write(tmp_path / "model", {"registry_name": "sly"}))

    def test_an_unregistered_name_says_what_to_install(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match=r"found 'mine'\. Install the package"):
            load(write(tmp_path / "model", {"registry_name": "mine"}))

    def test_lerobots_own_steps_are_made_by_either_name(self, tmp_path: Path) -> None:
        by_class = {"class": "lerobot.processor.rename_processor.RenameObservationsProcessorStep"}
        by_package = {"class": "lerobot.processor.IdentityProcessorStep"}
        registered = {"registry_name": "device_processor", "config": {"device": "cpu"}}
        steps = load(write(tmp_path / "model", by_class, by_package, registered)).steps
        assert [type(step).__name__ for step in steps] == [
            "RenameObservationsProcessorStep",
            "IdentityProcessorStep",
            "DeviceProcessorStep",
        ]

    def test_a_step_of_an_installed_plugin_is_made(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        package, site = "lerobot_policy_mine", tmp_path / "site"
        (site / package).mkdir(parents=True)
        (site / package / "__init__.py").touch()
        (site / package / "processor_mine.py").write_text(
            "from lerobot.processor import IdentityProcessorStep\nclass Mine(IdentityProcessorStep): ...\n"
        )
        info = site / f"{package}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        monkeypatch.syspath_prepend(str(site))
        (step,) = load(write(tmp_path / "model", {"class": f"{package}.processor_mine.Mine"})).steps
        assert type(step).__name__ == "Mine"
        del sys.modules[f"{package}.processor_mine"], sys.modules[package]


class TestSettings:
    @pytest.mark.parametrize(
        "value", ["/etc", "~/x", "../other", "inside/../../other", "link", "link/x", "a\0b"]
    )
    def test_a_path_out_of_the_checkpoint_is_refused(self, tmp_path: Path, value: str) -> None:
        model = tmp_path / "model"
        step = {"registry_name": "rename_observations_processor", "config": {"rename_map": {"a": value}}}
        path = write(model, step)
        (model / "link").symlink_to(tmp_path)
        with pytest.raises(CheckpointError, match=r"rename_map\.a = .* a path outside of the checkpoint"):
            load(path)

    @pytest.mark.parametrize(
        "value", ["observation.images.base", "google/paligemma-3b-pt-224", "tokenizer", ""]
    )
    def test_other_texts_are_allowed(self, tmp_path: Path, value: str) -> None:
        model = tmp_path / "model"
        step = {"registry_name": "rename_observations_processor", "config": {"rename_map": {"a": value}}}
        path = write(model, step)
        (model / "tokenizer").mkdir()
        assert load(path).steps[0].rename_map == {"a": value}

    def test_a_path_that_is_overridden_is_not_used(self, tmp_path: Path) -> None:
        """Checkpoints name the tokenizer's folder on the machine that they were trained on."""
        config = {"rename_map": {"a": "/elsewhere"}}
        path = write(tmp_path / "model", {"registry_name": "rename_observations_processor", "config": config})
        made = load(path, rename_observations_processor={"rename_map": {"a": "/mine"}})
        assert made.steps[0].rename_map == {"a": "/mine"}

    @pytest.mark.parametrize("name", ["/state.safetensors", "../state.safetensors", "link/state.safetensors"])
    def test_tensors_from_outside_are_not_read(self, tmp_path: Path, name: str) -> None:
        model = tmp_path / "model"
        path = write(model, {"registry_name": "normalizer_processor", "state_file": name})
        (model / "link").symlink_to(tmp_path)
        save_file({"x": torch.zeros(1)}, tmp_path / "state.safetensors")
        with pytest.raises(CheckpointError, match=r"'state_file': expected a \.safetensors file inside"):
            load(path)

    def test_pickled_tensors_are_not_read(self, tmp_path: Path, trace: Path) -> None:
        model = tmp_path / "model"
        path = write(model, {"registry_name": "normalizer_processor", "state_file": "state.pt"})
        torch.save(WritesWhenUnpickled(trace), model / "state.pt")
        with pytest.raises(CheckpointError, match=r"expected a \.safetensors file"):
            load(path)
        (model / "state.pt").rename(model / "state.safetensors")
        path.write_text(path.read_text().replace("state.pt", "state.safetensors"))
        with pytest.raises(CheckpointError, match=r"cannot be read as safetensors"):
            load(path)
        assert not trace.exists()

    def test_the_hubs_cache_may_link_within_itself(self, tmp_path: Path) -> None:
        blobs, model = tmp_path / "models--x" / "blobs", tmp_path / "models--x" / "snapshots" / "abc"
        blobs.mkdir(parents=True)
        model.mkdir(parents=True)
        save_file({"action.mean": torch.zeros(1), "action.std": torch.ones(1)}, blobs / "1")
        (model / "state.safetensors").symlink_to("../../blobs/1")
        config = {"features": {}, "norm_map": {}}
        step = {
            "registry_name": "normalizer_processor",
            "config": config,
            "state_file": "state.safetensors",
        }
        assert set(load(write(model, step)).steps[0].stats["action"]) == {"mean", "std"}

    def test_a_step_that_refuses_its_settings_is_named(self, tmp_path: Path) -> None:
        path = write(
            tmp_path / "model", {"registry_name": "device_processor", "config": {"float_dtype": "x"}}
        )
        with pytest.raises(CheckpointError, match=r"step 1: the step 'device_processor' cannot be made: .*x"):
            load(path)

    def test_an_override_of_a_step_that_is_not_there_is_an_error(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match=r"expected a step 'tokenizer_processor', found none"):
            load(write(tmp_path / "model"), tokenizer_processor={})


class WritesWhenUnpickled:
    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, (str(self.trace), "w"))


def test_lerobots_own_loader_goes_through_the_door(tmp_path: Path, payload: Path, trace: Path) -> None:
    step = {"class": "lerobot.envs.utils._load_module_from_path", "config": {"path": str(payload)}}
    path = write(tmp_path / "model", step)
    with processors_through_the_door(), pytest.raises(CheckpointError, match="not run"):
        DataProcessorPipeline.from_pretrained(path.parent, path.name)
    assert not trace.exists()
    with pytest.raises(TypeError):  # as lerobot has it: it calls what is named, and asks later
        DataProcessorPipeline.from_pretrained(path.parent, path.name)
    assert trace.exists()  # so much for the test; if this fails, lerobot was mended
