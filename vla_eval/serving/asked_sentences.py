"""What a served policy makes of the sentences that clients ask it with: said in the log, once."""

import logging

from vla_eval.checkpoints.trained_with import about_nothing_known, about_sentence
from vla_eval.core import EpisodeStart
from vla_eval.models.shared.sentence_reading import ReadingPolicy, SentenceReading, SentenceWatch
from vla_eval.serving.host import HostedPolicy
from vla_eval.tasks.interface import ANY_TASK

MAX_SENTENCES = 4096  # that are remembered; a client may ask with another one each time

logger = logging.getLogger(__name__)


class AskedSentences:
    """Compares sentences with those of the training, and looks at what was read of them."""

    def __init__(self, hosted: HostedPolicy) -> None:
        self._policy, self._name = hosted.policy, hosted.policy.spec.name
        self._trained = hosted.metadata.sentences
        self._watch = SentenceWatch(self._name)
        self._begun: set[tuple[str, str]] = set()
        if self._trained is None and hosted.metadata.weights_sha256 is not None:
            logger.info("%s", about_nothing_known(self._name))

    def begin(self, start: EpisodeStart) -> None:
        """Look at the sentence of an episode that begins."""
        asked = (start.task, start.instruction)
        if asked in self._begun or len(self._begun) >= MAX_SENTENCES:
            return
        self._begun.add(asked)
        line = about_sentence(self._trained, start.instruction, policy=self._name, task=start.task)
        if line is not None:
            logger.warning("%s", line)

    def answered(self, start: EpisodeStart) -> SentenceReading | None:
        """Return what was read of an episode's sentence, after an inference; None if that is not known."""
        if not isinstance(self._policy, ReadingPolicy):
            return None
        reading = self._policy.readings.get(start.instruction)
        if reading is not None:
            for line in self._watch.lines(reading, "" if start.task == ANY_TASK else start.task):
                logger.warning("%s", line)
        return reading
