"""A first inference that is late: the arm holds until then, and no frame is lost."""

import numpy as np
import pytest

from tests.test_rollout import HORIZON, Fixed, Pusher, env_for, start
from vla_eval.chunking import ChunkingSpec
from vla_eval.core import ActionChunk
from vla_eval.errors import SpecMismatchError
from vla_eval.rollout import RolloutSettings, rollout


def test_a_late_first_inference_is_given_its_frame_alone_or_all_before_it() -> None:
    chunking = ChunkingSpec(n_action_steps=4, first_inference_step=3)
    counts = {}
    for policy in (Pusher(reads="last", chunk_size=4), Pusher(reads="every", chunk_size=4)):
        (record,) = rollout(env_for(policy), policy, [start()], RolloutSettings(chunking=chunking))
        counts[policy.spec.reads] = (record.n_inferences, record.n_frames)

    # Inferences at 3, 7, … 59: fifteen. All frames up to step 59 are sixty.
    assert counts == {"last": (15, 15), "every": (15, 60)}


def test_a_first_inference_after_the_end_is_refused() -> None:
    policy = Fixed(ActionChunk(actions=np.zeros((99, 7), dtype=np.float32)), chunk_size=99)
    chunking = ChunkingSpec(n_action_steps=99, first_inference_step=HORIZON)
    with pytest.raises(
        SpecMismatchError, match=r"ends after 60 steps, before the first inference at step 60"
    ):
        rollout(env_for(policy), policy, [start()], RolloutSettings(chunking=chunking))
