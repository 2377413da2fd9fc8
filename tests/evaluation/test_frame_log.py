"""Which frames are kept of an episode before its response."""

from pathlib import Path

import numpy as np
import pytest

from tests.policies.remote.test_remote_policy import starts
from vla_eval.core import Observation, StepResult
from vla_eval.evaluation.memory_log import MOST_STEPS, EpisodeMemory, FrameLog
from vla_eval.records import EpisodeRecord
from vla_eval.storage.capture_files import frames_file
from vla_eval.task_state import Phase, PrivilegedState, TaskStatus

CUE = 30


def result(step: int, response_step: int, *, rendered: bool) -> StepResult:
    phase: Phase = "cue" if step < CUE else "delay" if step < response_step else "response"
    state = PrivilegedState(
        phase=phase,
        response_step=response_step,
        tcp_position_m=np.zeros(3),
        tcp_velocity_m_s=np.zeros(3),
        gripper_width_m=0.0,
        candidate_positions_m=np.zeros((3, 3)),
        shown_candidates=(1,) if phase == "cue" else (),
    )
    images = {"base_camera": np.full((64, 64, 3), step % 256, np.uint8)} if rendered else {}
    seen = Observation(step=step, images=images, state={}, privileged=state)
    return StepResult(observation=seen, status=TaskStatus(phase=None, success=False))


@pytest.mark.parametrize("response_step", [31, MOST_STEPS, MOST_STEPS + 1, 3 * MOST_STEPS, 550])
def test_at_most_so_many_frames_are_rendered_and_the_first_of_the_response_is_among_them(
    response_step: int, tmp_path: Path
) -> None:
    log, (start,) = FrameLog(), starts(1)
    assert log.wants_images(0)
    log.on_reset(start, result(0, response_step, rendered=True))
    for step in range(1, response_step + 20):
        action = np.zeros(7, np.float32)
        log.on_step(start, action, result(step, response_step, rendered=log.wants_images(step)))
    record = EpisodeRecord(task="T", policy="p", n_action_steps=1, run=0, seed=1, outcome="failure")
    log.write([start], [record], tmp_path)
    kept = EpisodeMemory.read(frames_file(tmp_path, record))
    every = -(-response_step // MOST_STEPS)
    steps = kept.steps.tolist()
    assert steps == [*range(0, response_step, every), response_step]
    assert len(steps) <= MOST_STEPS + 1
    assert kept.frames["base_camera"][:, 0, 0, 0].tolist() == [step % 256 for step in steps]
    assert kept.in_cue is not None and kept.in_cue.tolist() == [step < CUE for step in steps]
    assert kept.shown is not None and kept.shown[:, 1].tolist() == [step < CUE for step in steps]
