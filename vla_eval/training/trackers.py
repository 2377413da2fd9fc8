"""Metrics to services in addition to the file: wandb, trackio, TensorBoard. One that fails is left out."""

import contextlib
import functools
import importlib
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple  # wandb, trackio and lerobot are untyped

from accelerate import PartialState
from accelerate.tracking import TensorBoardTracker
from lerobot.common.wandb_utils import cfg_to_group, get_safe_wandb_artifact_name

from vla_eval.checkpoints.files import ADAPTER_CONFIG_FILE, CONFIG_FILE, MODEL_FOLDER, weights_file
from vla_eval.config.files import to_data
from vla_eval.errors import MissingDependencyError, TrainingError
from vla_eval.lock.switch import let_connect
from vla_eval.training.job import TrainingJob, lerobot_config
from vla_eval.training.run_folder import TRAIN_FOLDER

logger = logging.getLogger(__name__)

Line = Mapping[str, float | str]
"""One line of metrics, with its `step`."""
WANDB_RETRIES = 3
"""Of a request, with pauses of 2, 4, 8 s: by its own number wandb waits for days before a training begins."""
MAX_REASON = 300  # characters
TRAINING = "train"
"""Prefix of the names of a training's own metrics, as lerobot's logger has it."""
STILL_THERE = "metrics.jsonl has it all."


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """Where metrics go; `log` takes the prefix of their names, `close` whether the training ended well."""

    name: str
    log: Callable[[str, dict[str, float], int], object]
    close: Callable[[bool], object]
    save: Callable[[Path], object] = lambda _checkpoint: None


class Services:
    """The services of one training. A training does not depend on them: what fails is said once."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._services: list[Service] = []

    def begin(self, name: str, begin: Callable[[], Service]) -> None:
        """Add a service; without it, if it cannot be reached."""
        with self._may_fail(name):
            self._services.append(begin())

    def log(self, line: Line, prefix: str = TRAINING) -> None:
        """Log the numbers of a line of metrics."""
        numbers = {
            name: value for name, value in line.items() if name != "step" and not isinstance(value, str)
        }
        self._each(lambda service: service.log(prefix, numbers, int(line["step"])))

    def save(self, checkpoint: Path) -> None:
        """Hand over a checkpoint (`…/000100`)."""
        self._each(lambda service: service.save(checkpoint))

    def close(self, *, is_good: bool) -> None:
        """Wait until all has been sent."""
        self._each(lambda service: service.close(is_good))

    def _each(self, do: Callable[[Service], object]) -> None:
        for service in tuple(self._services):
            with self._may_fail(service.name):
                do(service)

    @contextlib.contextmanager
    def _may_fail(self, name: str) -> Iterator[None]:
        try:
            with contextlib.redirect_stdout(sys.stderr):  # standard output is for the checkpoint's folder
                yield
        except (MissingDependencyError, TrainingError):
            raise
        except Exception as exc:  # services raise what they like, and no training ends because of one
            self._services = [service for service in self._services if service.name != name]
            logger.info("%s", name, exc_info=exc)
            reason = f"{type(exc).__name__}: {' '.join(str(exc).split())}"
            self._say(f"warning: nothing more goes to {name} ({reason:.{MAX_REASON}}). {STILL_THERE}")


@contextlib.contextmanager
def services(job: TrainingJob, say: Callable[[str], None]) -> Iterator[Services]:
    """Give the services that a recipe asks for, while the context is open.

    A training that is resumed continues the runs of its name. Steps between the last checkpoint and a kill
    are then there twice; `metrics.jsonl` has each once.
    """
    found, asked = Services(say), [field for field in PACKAGES if getattr(job.recipe, field)]
    for field in asked:  # all of them, before one begins to write
        _require(field)
    for field in asked:
        found.begin(PACKAGES[field].name, functools.partial(PACKAGES[field].begin, job))
    is_good = False
    try:
        yield found
        is_good = True
    finally:
        found.close(is_good=is_good)


def _tensorboard(job: TrainingJob) -> Service:
    folder = job.out / "tensorboard"
    # What was logged after the checkpoint that training resumes from is not shown.
    tracker = TensorBoardTracker("", folder, purge_step=job.first_step + 1)
    tracker.main_process_only = False  # it is made in the first process alone
    PartialState(cpu=job.device == "cpu")  # as the training's `Accelerator` makes it; trackers log by it
    tracker.start()

    def log(prefix: str, numbers: dict[str, float], step: int) -> None:
        tracker.log(_named(prefix, numbers), step=step)

    return Service(name="TensorBoard", log=log, close=lambda _is_good: tracker.finish())


def _trackio(job: TrainingJob) -> Service:
    trackio: Any = importlib.import_module("trackio")
    # No figures of the machine: they would start threads that measure during the training.
    quiet = {"embed": False, "auto_log_gpu": False, "auto_log_cpu": False}
    name, settings = job.out.resolve().name, to_data(job.recipe)
    trackio.init(project=job.recipe.trackio_project, name=name, resume="allow", config=settings, **quiet)
    return Service(
        name="trackio",
        log=lambda _prefix, numbers, step: trackio.log(numbers, step=step),
        close=lambda _is_good: trackio.finish(),
    )


def _wandb(job: TrainingJob) -> Service:
    """Begin or resume a run of wandb; not by lerobot's logger, which overrules WANDB_MODE."""
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")  # to wandb's makers: nobody has asked for it
    wandb: Any = importlib.import_module("wandb")
    config, folder = lerobot_config(job), job.out / TRAIN_FOLDER
    folder.mkdir(exist_ok=True)
    try:
        run = wandb.init(
            **{"project": job.recipe.wandb_project, "id": job.run_id, "resume": "allow"},
            **{"dir": str(folder.resolve()), "config": config.to_dict(), "save_code": False},
            tags=cfg_to_group(config, return_list=True, truncate_tags=True),
            **{"name": config.job_name, "job_type": "train_eval"},
            settings={"silent": True, "x_graphql_retry_max": WANDB_RETRIES},
        )
    except (wandb.errors.UsageError, wandb.errors.AuthenticationError, ValueError) as exc:
        wandb.teardown()
        raise TrainingError(
            f"finetune.wandb_project: wandb refuses to begin ({' '.join(str(exc).split())}). Set "
            f"WANDB_API_KEY or run `wandb login`; or set WANDB_MODE to offline or disabled, or leave the "
            f"field out: {STILL_THERE}"
        ) from exc

    def close(is_good: bool) -> None:
        run.finish(exit_code=0 if is_good else 1)
        wandb.teardown()  # else the next training of this process would get this one's settings

    def save(checkpoint: Path) -> None:
        name = get_safe_wandb_artifact_name(f"{cfg_to_group(config)}-{checkpoint.name}")
        artifact = wandb.Artifact(name, type="model")
        for file in _of_artifact(checkpoint / MODEL_FOLDER):
            artifact.add_file(str(file))
        run.log_artifact(artifact)

    return Service(
        name="wandb",
        log=lambda prefix, numbers, step: run.log(_named(prefix, numbers), step=step),
        close=close,
        save=save,
    )


def _of_artifact(folder: Path) -> list[Path]:
    """Return what lerobot's logger uploads: the weights, and what an adapter needs in addition."""
    files = [weights_file(folder)]
    if (folder / ADAPTER_CONFIG_FILE).is_file():
        files += [folder / ADAPTER_CONFIG_FILE, folder / CONFIG_FILE]
    return [file for file in files if file is not None]


def _named(prefix: str, numbers: dict[str, float]) -> dict[str, float]:
    return {f"{prefix}/{name}": value for name, value in numbers.items()}


class _Package(NamedTuple):
    """What a field of a recipe needs: how to install it, one of these modules, and how to begin."""

    name: str
    install: str
    modules: tuple[str, ...]
    begin: Callable[[TrainingJob], Service]


PACKAGES = {
    "wandb_project": _Package("wandb", "wandb", ("wandb",), _wandb),
    "trackio_project": _Package("trackio", "'mikasa-vla-eval[trackio]'", ("trackio",), _trackio),
    "tensorboard": _Package(
        "TensorBoard",
        "'mikasa-vla-eval[tensorboard]'",
        ("torch.utils.tensorboard", "tensorboardX"),
        _tensorboard,
    ),
}


def _require(field: str) -> None:
    """Import the package that a field of the recipe needs; what it connects to is let through."""
    package, missing = PACKAGES[field], None
    if package.begin is not _tensorboard:
        let_connect(f"finetune.{field}", "git")
    for module in package.modules:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as exc:
            missing = missing or exc
        else:
            return
    assert missing is not None
    raise MissingDependencyError(
        f"finetune.{field}: the package '{missing.name}' is not installed. Install it with pip install "
        f"{package.install}, or leave the field out: {STILL_THERE}"
    ) from missing
