"""One fine-tuning of a table as a job of a worker process. Imports no torch: a cluster's actors need none."""

from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.workers.jobs import Job

RUNNER = "vla_eval.training.worker:FinetuneRunner"


@dataclass(frozen=True, slots=True, kw_only=True)
class FinetuneJob(Job):
    """One fine-tuning; `command` is what the user typed, `name` what messages call it."""

    config: FinetuneConfig
    command: str
    name: str
    n_items: ClassVar[int] = 1

    @property
    def setup_key(self) -> Hashable:
        """See `workers.Job`: each has a process of its own."""
        return self.config.out


@dataclass(frozen=True, slots=True, kw_only=True)
class Finetuned:
    """A fine-tuning is finished; its checkpoint is in the folder of its run."""

    checkpoint: Path
