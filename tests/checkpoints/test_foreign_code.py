"""Every place where a name or a pickle in somebody's file could become code: a payload never runs.

The places are those of docs/security.md; names of processor steps are in test_processor_door.py.
"""

import json
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
import torch
import transformers
from safetensors.torch import save_file
from transformers import AutoConfig, AutoImageProcessor, AutoProcessor, AutoTokenizer

from tests.training import tiny_trainings
from tests.training.tiny_trainings import TASK, act, context
from vla_eval.checkpoints.adapter_config import read_adapter_config
from vla_eval.checkpoints.conversion import check_free
from vla_eval.checkpoints.foreign_code import no_foreign_code
from vla_eval.checkpoints.loading import LoadOptions, read_config
from vla_eval.cli.main import main
from vla_eval.data.opening import open_local_dataset
from vla_eval.errors import CheckpointError, DatasetError, TrainingError
from vla_eval.models.octo.conversion import read_parameters
from vla_eval.models.openvla.conversion import read_weights
from vla_eval.models.openvla.conversion_options import OpenVLAOptions
from vla_eval.models.openvla.sizes import NetworkSizes
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.training.finetune import finetune

offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own
RUNS_CODE = "get_class_in_module"
"""The only function of transformers that executes a file; a test counts who calls it."""
CALLS_IT = ("transformers.dynamic_module_utils", "transformers.generation.utils")
SHIPPED = Path(__file__).parents[2] / "checkpoints" / "memory_color3"
KilledAt = Callable[[int], AbstractContextManager[None]]


class WritesWhenUnpickled:
    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, (str(self.trace), "w"))


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    """What a payload writes if it runs."""
    return tmp_path / "it-ran"


@pytest.fixture
def foreign(tmp_path: Path, trace: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with code, as a repository of the Hub has it."""
    folder = tmp_path / "foreign"
    (folder / "custom_generate").mkdir(parents=True)
    code = f"open({str(trace)!r}, 'w').close()\nclass Theirs: ...\ndef generate(*_, **__): ...\n"
    for name in ("theirs.py", "custom_generate/generate.py"):
        (folder / name).write_text(code)
    monkeypatch.syspath_prepend(str(folder))

    def ask(*_: object) -> str:
        raise AssertionError("a person is asked whether the code is to be run")

    monkeypatch.setattr("builtins.input", ask)
    return folder


def describe(folder: Path, file: str, **data: Any) -> None:
    (folder / file).write_text(json.dumps(data))


class TestTransformers:
    @pytest.mark.parametrize("trusted", [None, True])
    @pytest.mark.parametrize(
        ("make", "file"),
        [
            (AutoTokenizer, "tokenizer_config.json"),
            (AutoProcessor, "processor_config.json"),
            (AutoImageProcessor, "preprocessor_config.json"),
            (AutoConfig, "config.json"),
        ],
    )
    def test_auto_map_is_not_followed(
        self, foreign: Path, trace: Path, make: Any, file: str, trusted: bool | None
    ) -> None:
        named = [None, "theirs.Theirs"] if make is AutoTokenizer else "theirs.Theirs"  # slow, fast
        describe(foreign, file, auto_map={make.__name__: named})
        with pytest.raises(CheckpointError, match="It is not run"), no_foreign_code("smolvla"):
            make.from_pretrained(str(foreign), trust_remote_code=trusted)
        assert not trace.exists()

    @pytest.mark.parametrize("name", ["RagRetriever", "RagTokenizer", "Trainer", "pipeline", "AutoModel"])
    def test_a_tokenizer_class_that_is_none_is_not_called(self, foreign: Path, name: str) -> None:
        describe(foreign, "tokenizer_config.json", tokenizer_class=name)
        with pytest.raises(CheckpointError, match=f"names '{name}'.*not called"), no_foreign_code("pi0"):
            AutoTokenizer.from_pretrained(str(foreign))

    def test_a_processor_class_that_is_none_is_not_called(self, foreign: Path) -> None:
        describe(foreign, "processor_config.json", processor_class="AutoModel")
        with pytest.raises(CheckpointError, match="names 'AutoModel'"), no_foreign_code("smolvla"):
            AutoProcessor.from_pretrained(str(foreign))

    def test_a_generation_of_ones_own_is_not_run(self, foreign: Path, trace: Path) -> None:
        load: Any = transformers.GenerationMixin().load_custom_generate
        with (
            pytest.raises(CheckpointError, match=r"custom_generate/generate\.py' is in .* not run"),
            no_foreign_code("pi0"),
        ):
            load(str(foreign), trust_remote_code=True)
        assert not trace.exists()

    def test_one_function_runs_code_and_two_modules_call_it(self) -> None:
        """If this fails, another version of transformers has another way: look at foreign_code.py."""
        root = Path(transformers.__file__).parent
        files = [
            file
            for folder in (".", "generation", "utils", "models/auto")
            for file in (root / folder).glob("*.py")
        ]
        texts = {
            ".".join(file.relative_to(root.parent).with_suffix("").parts): file.read_text() for file in files
        }
        calls = {name for name, text in texts.items() if f"{RUNS_CODE}(" in text}
        assert calls == set(CALLS_IT)
        runs = {name for name, text in texts.items() if "exec_module(" in text}
        assert runs == {"transformers.dynamic_module_utils", "transformers.utils.import_utils"}


class TestAdapters:
    @pytest.mark.parametrize(
        "change",
        [
            {"megatron_config": {"a": 1}, "megatron_core": "theirs"},
            {"megatron_core": "theirs"},
            {"peft_type": "XLORA", "adapters": {"a": "theirs"}},
            {"peft_type": "theirs.Theirs"},
            {"corda_config": {"cache_file": "x.pt"}},
            {"lora_ga_config": {"cache_file": "x.pt"}},
            {"init_lora_weights": "corda"},
            {"loftq_config": {"loftq_bits": 4}},
            {"layer_replication": [[0, 10**9]]},
            {"runtime_config": {"ephemeral_gpu_offload": True}},
            {"a_field_of_tomorrow": "theirs"},
        ],
    )
    def test_only_plain_lora_is_given_to_peft(
        self, foreign: Path, trace: Path, change: dict[str, Any]
    ) -> None:
        data = {"peft_type": "LORA", "r": 4, "target_modules": ["q"], **change}
        describe(foreign, "adapter_config.json", **data)
        with pytest.raises(CheckpointError, match=r"adapter_config\.json: '\w+': expected"):
            read_adapter_config(foreign / "adapter_config.json")
        assert not trace.exists()

    def test_what_peft_writes_is_accepted_and_names_nothing(self, foreign: Path) -> None:
        from peft import LoraConfig

        made: Any = LoraConfig(r=4, lora_alpha=8, target_modules=r".*\.q", modules_to_save=["head"])
        made.base_model_name_or_path = "/base"
        made.save_pretrained(str(foreign), auto_mapping_dict={"parent_library": "theirs"})
        found = read_adapter_config(foreign / "adapter_config.json")
        assert found == LoraConfig(
            r=4,
            lora_alpha=8,
            target_modules=r".*\.q",
            modules_to_save=["head"],
            base_model_name_or_path="/base",
        )


class TestConfig:
    @pytest.mark.parametrize(
        "change",
        [
            {"type": "os.system"},
            {"type": "theirs.Theirs"},
            {"type": "lerobot.configs.policies.PreTrainedConfig"},
            {"type": ["act"]},
            {"type": None},
            {"_target_": "theirs.Theirs"},
            {"auto_map": {"AutoConfig": "theirs.Theirs"}},
            {"discover_packages_path": "theirs"},
            {"optimizer": {"type": "theirs.Theirs"}},
            *({"pretrained_revision": name} for name in ("/dev/zero", "../x", "a/../b", "", "a\0", "~/x")),
        ],
    )
    def test_it_names_no_code(self, foreign: Path, trace: Path, change: dict[str, Any]) -> None:
        described = {"input_features": {}, "output_features": {}}
        describe(foreign, "config.json", **{"type": "act", **described, **change})
        with pytest.raises(CheckpointError, match=r"config\.json: "):
            read_config(foreign, LoadOptions(device="cpu"))
        assert not trace.exists()


class TestPickles:
    def test_a_head_of_openvla_holds_tensors_only(self, tmp_path: Path, trace: Path) -> None:
        save_file({"x": torch.zeros(1)}, tmp_path / "model.safetensors")
        torch.save({"a": WritesWhenUnpickled(trace)}, tmp_path / "action_head--5_checkpoint.pt")
        options = OpenVLAOptions(head="l1", allow_pickled=True)
        with pytest.raises(CheckpointError, match="expected pickled tensors and nothing else"):
            read_weights(tmp_path, options, NetworkSizes())
        torch.save([torch.zeros(1)], tmp_path / "action_head--5_checkpoint.pt")
        with pytest.raises(CheckpointError, match="expected tensors by name, found list"):
            read_weights(tmp_path, options, NetworkSizes())
        assert not trace.exists()

    def test_a_pickle_in_the_place_of_octos_parameters_is_not_read(self, tmp_path: Path, trace: Path) -> None:
        torch.save(WritesWhenUnpickled(trace), tmp_path / "checkpoint")
        with pytest.raises(CheckpointError, match="not flax's msgpack"):
            read_parameters(tmp_path)
        assert not trace.exists()

    @pytest.mark.parametrize(
        "data",
        [
            b"\xc9\x00\x00\x00\x09\x01\x93\x91\x01\xa1O\xc4\x01a",  # an array of objects
            b"\x91" * 100_000,  # lists without end
            b"\xa2\xff\xff",  # text that is no UTF-8
        ],
    )
    def test_msgpack_of_other_things_is_an_error(self, tmp_path: Path, data: bytes) -> None:
        (tmp_path / "checkpoint").write_bytes(data)
        with pytest.raises(CheckpointError, match=r"checkpoint: "):
            read_parameters(tmp_path)


class TestDatasets:
    @pytest.mark.parametrize(
        "place", ["/etc/{chunk_index}/{file_index}.parquet", "../{chunk_index}/{file_index}"]
    )
    def test_files_of_a_dataset_lie_inside_of_it(self, recorded: Path, place: str) -> None:
        info = recorded / "meta" / "info.json"
        info.write_text(json.dumps({**json.loads(info.read_text()), "data_path": place}))
        with pytest.raises(DatasetError, match="expected a path inside of the dataset"):
            open_local_dataset(recorded)


@pytest.mark.usefixtures("small_act")
class TestTraining:
    PLANTED = (
        *(
            "optimizer.pt",
            "optimizer.bin",
            "optimizer_state.pt",
            "scheduler.pt",
            "scheduler.bin",
            "scaler.pt",
        ),
        *("rng_state.pth", "random_states_0.pkl", "custom_checkpoint_0.pkl", "training_state.pt"),
    )

    def test_pickles_beside_a_state_are_not_read_and_steps_go_through_the_door(
        self, recorded: Path, tmp_path: Path, killed_at: KilledAt, trace: Path
    ) -> None:
        run = tmp_path / "run"
        with killed_at(3):
            finetune(act(recorded, run))
        checkpoint = run / "train" / "checkpoints" / "000002"
        model, state = checkpoint / "pretrained_model", checkpoint / "training_state"
        for folder in (model, state):
            for name in (*self.PLANTED, "pytorch_model.bin", "training_args.bin"):
                torch.save(WritesWhenUnpickled(trace), folder / name)
        hostile = {"class": "builtins.open", "config": {"file": str(trace), "mode": "w"}}
        file = model / "policy_preprocessor.json"
        whole = file.read_text()
        file.write_text(json.dumps({**json.loads(whole), "steps": [hostile]}))
        with pytest.raises(CheckpointError, match=r"names the code 'builtins\.open'"):
            finetune(act(recorded, run))
        assert not trace.exists()
        file.write_text(whole)

        rng = state / "rng_state.safetensors"
        kept = rng.read_bytes()
        torch.save(WritesWhenUnpickled(trace), rng)
        with pytest.raises(TrainingError, match=r"000002: the state of the training cannot be read"):
            finetune(act(recorded, run))
        rng.write_bytes(kept)
        finetune(act(recorded, run))  # goes on to the end
        assert not trace.exists()


class TestCommands:
    @pytest.fixture
    def hostile(self, tmp_path: Path, trace: Path) -> Path:
        folder = tmp_path / "copied"
        shutil.copytree(SHIPPED, folder)
        payload = tmp_path / "payload.py"
        payload.write_text(f"open({str(trace)!r}, 'w').close()\n")
        file = folder / "policy_preprocessor.json"
        data = json.loads(file.read_text())
        step = {"class": "lerobot.envs.utils._load_module_from_path", "config": {"path": str(payload)}}
        file.write_text(json.dumps({**data, "steps": [step, *data["steps"]]}))
        return folder

    def test_verify_refuses_it(self, hostile: Path, trace: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["checkpoint", "verify", str(hostile)]) == 1
        assert "It is not run" in capsys.readouterr().err
        assert not trace.exists()

    def test_a_policy_of_an_evaluation_refuses_it(self, hostile: Path, trace: Path) -> None:
        with pytest.raises(CheckpointError, match="It is not run"):
            make_lerobot(context(), checkpoint=str(hostile))
        assert not trace.exists()

    @pytest.mark.slow  # a worker that imports torch and lerobot
    def test_eval_refuses_it(
        self, hostile: Path, tmp_path: Path, trace: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        arguments = ["--task", TASK, "--policy", str(hostile), "--episodes", "1", "--workers", "1"]
        settings = ["--set", "simulator=fake", "--out", str(tmp_path / "run")]
        assert main(["eval", *arguments, *settings]) == 1
        assert "It is not run" in capfd.readouterr().err
        assert not trace.exists()

    def test_merge_refuses_an_adapter_that_is_its_own_base(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        folder, out = tmp_path / "lora", tmp_path / "out"
        shutil.copytree(SHIPPED, folder)
        (folder / "model.safetensors").rename(folder / "adapter_model.safetensors")
        described = {"peft_type": "LORA", "base_model_name_or_path": str(folder)}
        describe(folder, "adapter_config.json", **described)
        assert main(["checkpoint", "merge", str(folder), "--out", str(out)]) == 1
        assert "which is the adapter itself" in capsys.readouterr().err
        check_free(out)
