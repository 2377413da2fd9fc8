"""Run an episode again with the actions it had, this time with images. The policy is not asked again."""

from collections.abc import Callable

import numpy as np

from vla_eval.core import SimEnv, Stage, StepResult
from vla_eval.errors import ViewingError
from vla_eval.viz.tape import EpisodeTape, Tapes


def film_again(
    tape: EpisodeTape, env: SimEnv, heartbeat: Callable[[Stage], None] = lambda _stage: None
) -> EpisodeTape:
    """Return the tape of an episode with images at its stride, and at the horizon."""
    film = Tapes({tape.start.slot}, frame_stride=tape.frame_stride)
    for one in tape.steps:
        if one.action is None:
            heartbeat("reset")
            result = env.reset({0: tape.start.seed}, render=True)[0]
            film.on_reset(tape.start, result)
        else:
            heartbeat("step")
            render = frozenset({0} if film.wants_images(one.step) else ())
            result = env.step({0: one.action}, render=render)[0]
            film.on_step(tape.start, one.action, result)
        if not _is_same(one.result, result):
            raise ViewingError(
                f"{tape.start.task}, run {tape.start.run}, seed {tape.start.seed}: run again with the same "
                f"actions to be filmed, the episode is another one from control step {one.step} on. So this "
                "simulator does not repeat an episode. Capture it while it runs: `all`, or a number of "
                "episodes, for --capture-video or --capture-rrd."
            )
    filmed = film.episodes[tape.start.slot]
    filmed.chunks = tape.chunks
    return filmed


def _is_same(first: StepResult, second: StepResult) -> bool:
    """Whether two results are equal to the bit, but for images and the true state of the world."""
    states, others = first.observation.state, second.observation.state
    return (
        (first.status, first.reward, first.wording) == (second.status, second.reward, second.wording)
        and states.keys() == others.keys()
        and all(np.array_equal(states[name], others[name]) for name in states)
    )
