"""The inside of a worker process that fine-tunes: one fine-tuning is one job, and resumes if run again."""

import functools
import logging
from collections.abc import Callable

from vla_eval.errors import VlaEvalError
from vla_eval.training.finetune import finetune
from vla_eval.training.finetune_jobs import Finetuned, FinetuneJob
from vla_eval.workers.inside import Heartbeat
from vla_eval.workers.messages import Failed, Notice, describe_error

logger = logging.getLogger(__name__)


class FinetuneRunner:
    """Does one fine-tuning after the other."""

    def __init__(self, heartbeat: Heartbeat, _tell: Callable[[Notice], None]) -> None:
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
