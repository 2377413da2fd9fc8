"""The inside of a worker process that fine-tunes: one fine-tuning is one job, and resumes if run again."""

import functools
import logging
from collections.abc import Hashable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.errors import VlaEvalError
from vla_eval.training.finetune import finetune
from vla_eval.workers.inside import Heartbeat, SharedStage, detach, serve
from vla_eval.workers.messages import Failed, describe_error

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class FinetuneJob:
    """One fine-tuning.

    Attributes:
        config: what to train on what.
        command: what the user typed, for the record.
        name: what messages call it.
    """

    config: FinetuneConfig
    command: str
    name: str

    @property
    def setup_key(self) -> Hashable:
        """See `workers.Job`: each has a process of its own."""
        return self.config.out


@dataclass(frozen=True, slots=True, kw_only=True)
class Finetuned:
    """A fine-tuning is finished; its checkpoint is in the folder of its run."""

    checkpoint: Path


class FinetuneRunner:
    """Does one fine-tuning after the other."""

    def __init__(self, heartbeat: Heartbeat) -> None:
        """Start with nothing made."""
        self._heartbeat = heartbeat

    def answer(self, job: FinetuneJob) -> Finetuned | Failed:
        """Fine-tune; whatever goes wrong becomes a `Failed`."""
        self._heartbeat.begin_batch()
        self._heartbeat("setup")
        try:
            say = functools.partial(logger.warning, "%s: %s", job.name)
            summary = finetune(job.config, command=job.command, say=say)
        except BaseException as exc:  # as in every worker: nothing ends it unseen
            logger.exception("%s", job.name)
            return Failed(error=describe_error(exc, "setup"), refused=isinstance(exc, VlaEvalError))
        return Finetuned(checkpoint=summary.checkpoint)

    def close(self) -> None:
        """Keep nothing."""


def finetune_main(connection: Connection, shared: SharedStage, log: Path) -> None:
    """Fine-tune for the parent until it closes the pipe; the entry point of a worker process."""
    detach(log)
    serve(connection, FinetuneRunner(Heartbeat(shared)))
