"""One fine-tuning of a table as a job of a worker process. Imports no torch: a cluster's actors need none."""

import importlib
from collections.abc import Hashable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.workers.inside import Heartbeat, SharedStage, detach, serve

WORKER_MODULE = "vla_eval.training.worker"


@dataclass(frozen=True, slots=True, kw_only=True)
class FinetuneJob:
    """One fine-tuning; `command` is what the user typed, `name` what messages call it."""

    config: FinetuneConfig
    command: str
    name: str

    @property
    def setup_key(self) -> Hashable:
        """See `workers.Job`: each has a process of its own."""
        return self.config.out

    @property
    def n_items(self) -> int:
        """One fine-tuning."""
        return 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Finetuned:
    """A fine-tuning is finished; its checkpoint is in the folder of its run."""

    checkpoint: Path


def finetune_main(connection: Connection, shared: SharedStage, log: Path) -> None:
    """Fine-tune for the parent until it closes the pipe; the entry point of a worker process."""
    detach(log)
    runner = importlib.import_module(WORKER_MODULE).FinetuneRunner  # torch is imported by the worker alone
    serve(connection, runner(Heartbeat(shared)))
