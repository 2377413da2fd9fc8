"""Services that get metrics: none of them ends a training, or is part of what a run is compared by."""

import math
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tests.training import test_held_out, tiny_trainings
from tests.training.test_held_out import ON_FAKE, same_weights
from tests.training.tiny_trainings import SHORT, TINY_ACT, act
from vla_eval.cli.main import main
from vla_eval.errors import MissingDependencyError, TrainingError
from vla_eval.training.finetune import finetune

pytestmark = pytest.mark.usefixtures("small_act")
quick_evaluation = test_held_out.quick_evaluation
offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own

FAILURES = [OSError(28, "No space left on device"), RuntimeError("no\nserver"), KeyError("run")]


class Fake:
    """Stands for a package: calls its methods by name, and fails at one of them."""

    def __init__(self, fails_at: str | None = None, failure: Exception | None = None) -> None:
        self.calls: list[str] = []
        self.logged: list[tuple[dict[str, float], int]] = []
        self._fails_at, self._failure = fails_at, failure

    def call(self, name: str) -> None:
        self.calls.append(name)
        if name == self._fails_at and self._failure is not None:
            raise self._failure

    def log(self, values: dict[str, float], step: int) -> None:
        self.call("log")
        self.logged.append((values, step))

    def as_trackio(self) -> Any:
        module: Any = ModuleType("trackio")
        module.init = lambda **_: self.call("begin")
        module.log = self.log
        module.finish = lambda: self.call("close")
        return module

    def as_wandb(self) -> Any:
        run = SimpleNamespace(
            log=self.log,
            log_artifact=lambda _: self.call("save"),
            finish=lambda exit_code: self.call("close"),
        )

        def init(**_: Any) -> Any:
            self.call("begin")
            return run

        import wandb  # here: it takes seconds, and each test process imports this module

        module: Any = ModuleType("wandb")
        module.init, module.errors, module.teardown = init, wandb.errors, lambda: None
        module.Artifact = wandb.Artifact
        return module

    def as_tensorboard(self) -> Any:
        module: Any = ModuleType("torch.utils.tensorboard")

        def writer(_folder: str, **_: Any) -> Any:
            self.call("begin")
            return SimpleNamespace(
                add_scalar=lambda name, value, global_step: self.log({name: value}, global_step),
                flush=lambda: None,
                close=lambda: self.call("close"),
            )

        module.SummaryWriter = writer
        return module


SERVICES: dict[str, tuple[str, Any, dict[str, Any]]] = {
    "trackio": ("trackio", Fake.as_trackio, {"trackio_project": "p"}),
    "wandb": ("wandb", Fake.as_wandb, {"wandb_project": "p"}),
    "TensorBoard": ("torch.utils.tensorboard", Fake.as_tensorboard, {"tensorboard": True}),
}


@pytest.mark.parametrize("service", SERVICES)
def test_a_service_gets_what_the_file_gets(
    service: str, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick_evaluation: object
) -> None:
    fake, (module, make, fields) = Fake(), SERVICES[service]
    monkeypatch.setitem(sys.modules, module, make(fake))
    config = test_held_out.act(recorded, tmp_path / "run", finetune={"steps": 2, **fields}, held_out=ON_FAKE)
    finetune(config)
    prefix = "" if service == "trackio" else "train/"
    losses = [(values[f"{prefix}loss"], step) for values, step in fake.logged if f"{prefix}loss" in values]
    found = test_held_out.metrics(tmp_path / "run")
    assert losses == [(value, int(step)) for step, value in found if not step.startswith("eval")]
    prefix = "" if service == "trackio" else "held_out/"
    assert any(f"{prefix}success_once" in values and step == 2 for values, step in fake.logged)
    assert fake.calls[0] == "begin" and fake.calls[-1] == "close"
    assert fake.calls.count("save") == (1 if service == "wandb" else 0)


@pytest.mark.parametrize("fails_at", ["begin", "log", "save", "close"])
def test_no_failure_of_a_service_ends_a_training_or_changes_it(
    fails_at: str, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finetune(act(recorded, tmp_path / "plain", steps=2))
    fakes = {name: Fake(fails_at, failure) for name, failure in zip(SERVICES, FAILURES, strict=True)}
    fields: dict[str, Any] = {"steps": 2}
    for name, (module, make, own) in SERVICES.items():
        monkeypatch.setitem(sys.modules, module, make(fakes[name]))
        fields |= own
    lines: list[str] = []
    assert finetune(act(recorded, tmp_path / "run", **fields), say=lines.append).is_finished
    assert same_weights(tmp_path / "plain", tmp_path / "run")
    warned = sorted(line.split(" (")[0] for line in lines if line.startswith("warning: nothing more"))
    failing = SERVICES if fails_at != "save" else ("wandb",)  # the others keep no checkpoints
    assert warned == sorted(f"warning: nothing more goes to {name}" for name in failing)
    for name in failing:  # it is not asked again
        assert fakes[name].calls[-1] == fails_at


def test_a_training_that_fails_tells_its_services(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = Fake()
    monkeypatch.setitem(sys.modules, "wandb", fake.as_wandb())
    no_number = SimpleNamespace(inf=math.inf, isfinite=lambda _: False)
    monkeypatch.setattr("vla_eval.training.loop.math", no_number)
    with pytest.raises(TrainingError, match="the loss is"):
        finetune(act(recorded, tmp_path / "run", wandb_project="p"))
    assert fake.calls[-1] == "close"


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("module", "fields", "install"),
    [
        ("trackio", {"trackio_project": "p", "wandb_project": "p"}, "'mikasa-vla-eval[trackio]'"),
        ("wandb", {"wandb_project": "p"}, "wandb"),
        ("tensorboard", {"tensorboard": True, "wandb_project": "p"}, "'mikasa-vla-eval[tensorboard]'"),
    ],
)
def test_a_package_that_is_not_installed_is_named_and_nothing_is_left_behind(
    module: str,
    fields: dict[str, Any],
    install: str,
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    monkeypatch.delitem(sys.modules, "torch.utils.tensorboard", raising=False)
    with pytest.raises(MissingDependencyError, match=re.escape(f"pip install {install},")):
        finetune(act(recorded, tmp_path / "run", **fields))
    assert not (tmp_path / "run").exists()
    finetune(act(recorded, tmp_path / "run", steps=1))  # the corrected command


@pytest.fixture
def no_account(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let wandb know no key, no settings and no earlier session."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    for name in ("WANDB_API_KEY", "WANDB_MODE", "WANDB_DIR", "NETRC"):
        monkeypatch.delenv(name, raising=False)
    import wandb

    wandb.teardown()
    yield
    wandb.teardown()


@pytest.mark.usefixtures("no_account")
@pytest.mark.parametrize("variables", [{}, {"WANDB_MODE": "of"}, {"WANDB_API_KEY": "short"}])
def test_settings_that_wandb_refuses_are_one_message_before_the_folder(
    variables: dict[str, str], recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    run = tmp_path / "run"
    with pytest.raises(TrainingError, match=r"wandb refuses to begin \(.*WANDB_API_KEY.*WANDB_MODE") as error:
        finetune(act(recorded, run, wandb_project="p"))
    assert "\n" not in str(error.value)
    assert not run.exists()
    monkeypatch.setenv("WANDB_MODE", "disabled")
    finetune(act(recorded, run, steps=1, wandb_project="p"))
    assert not list(run.glob("train/wandb/*run-*"))


def offline_runs(run: Path) -> list[Path]:
    return sorted((run / "train" / "wandb").glob("offline-run-*"), key=lambda folder: folder.stat().st_ctime)


def logged_steps(folder: Path) -> list[int]:
    from wandb.proto import wandb_internal_pb2
    from wandb.sdk.internal.datastore import DataStore

    store, steps = DataStore(), []
    store.open_for_scan(str(next(folder.glob("*.wandb"))))
    while (data := store.scan_data()) is not None:
        record = wandb_internal_pb2.Record.FromString(data)
        names = ["/".join([item.key, *item.nested_key]) for item in record.history.item]
        if any("train/loss" in name for name in names):
            steps.append(record.history.step.num)
    return steps


@pytest.mark.sampled(4)
@pytest.mark.usefixtures("no_account")
@pytest.mark.parametrize("name", ["plain", "run[1]*"])
@pytest.mark.parametrize("cleaned", [False, True])
def test_wandb_offline_continues_its_run_in_any_folder_under_the_lock(
    name: str,
    cleaned: bool,
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    killed_at: Any,
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    run = tmp_path / name
    fields = {**SHORT, "wandb_project": "p", **{f"policy.{key}": value for key, value in TINY_ACT.items()}}
    sets = [word for field, value in fields.items() for word in ("--set", f"{field}={value}")]
    command = ["finetune", "--policy", "act", "--dataset", str(recorded), "--allow-unreplayed"]
    command += ["--device", "cpu", *sets, "--out", str(run)]
    with killed_at(3):
        main(command)
    (first,) = offline_runs(run)
    assert logged_steps(first) == [1, 2, 3]
    run_id = first.name.split("-")[3]  # offline-run-TIME-ID, or …-1 if TIME, in seconds, is the same
    if cleaned:
        shutil.rmtree(run / "train" / "wandb")
    assert main(command) == 0
    last = offline_runs(run)[-1]
    assert last.name.split("-")[3] == run_id
    assert logged_steps(last) == [3, 4]


def test_services_may_be_changed_when_a_run_is_resumed(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed_at: Any
) -> None:
    finetune(act(recorded, tmp_path / "whole"))
    for number, (module, make, fields) in enumerate(SERVICES.values()):
        monkeypatch.setitem(sys.modules, module, make(Fake()))
        run = tmp_path / f"run{number}"
        with killed_at(3):
            finetune(act(recorded, run, **(fields if number % 2 else {})))
        finetune(act(recorded, run, **({} if number % 2 else fields)))
        assert same_weights(run, tmp_path / "whole")


def test_tensorboard_shows_each_step_once_after_a_resume(
    recorded: Path, tmp_path: Path, killed_at: Any
) -> None:
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    run = tmp_path / "run[1]"
    with killed_at(3):
        finetune(act(recorded, run, tensorboard=True))
    finetune(act(recorded, run, tensorboard=True))
    events = reading.EventAccumulator(str(run / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("train/loss")] == [1, 2, 3, 4]
