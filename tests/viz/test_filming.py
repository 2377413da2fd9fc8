"""Episodes that are run again to be filmed are the episodes that were."""

import dataclasses
from contextlib import closing

import numpy as np
import pytest

from tests.viz.test_capture import CAMERAS, SHORT, TASK, play
from vla_eval.config.environment import HUMAN_CAMERA, EnvSettings
from vla_eval.config.evaluation import CaptureConfig
from vla_eval.envs.factory import make_env
from vla_eval.errors import ViewingError
from vla_eval.testing.claims import same_observation
from vla_eval.viz.filming import film_again
from vla_eval.viz.tape import Tapes

CAPTURED = EnvSettings(
    task=TASK, kwargs=SHORT, simulator="fake", cameras=CAMERAS, privileged=True, human_camera_stride=2
)


class TestFilmedAgain:
    """An episode that was run without images, and again with the same actions."""

    def test_it_is_the_tape_that_would_have_been_made_at_once(self) -> None:
        _, record, live = play(captured=True)
        plain, again, unseen = play(captured=False, tapes=Tapes({0}, frame_stride=2, with_images=False))
        assert again == record
        assert not any(HUMAN_CAMERA in one.result.observation.images for one in unseen.episodes[0].steps)
        n_inferences = len(plain.frames)
        with closing(make_env(CAPTURED)) as env:
            filmed = film_again(unseen.episodes[0], env)
        assert len(plain.frames) == n_inferences  # the policy is not asked again
        assert [chunk.step for chunk in filmed.chunks] == [chunk.step for chunk in live.episodes[0].chunks]
        for first, second in zip(live.episodes[0].captured(), filmed.captured(), strict=True):
            assert first.step == second.step
            assert same_observation(first.result.observation, second.result.observation)

    @pytest.mark.parametrize("fault", ["seed", "state", "reward"])
    def test_another_episode_is_not_shown_in_its_place(self, fault: str) -> None:
        _, _, tapes = play(captured=False, tapes=Tapes({0}, frame_stride=2, with_images=False))
        tape = tapes.episodes[0]
        if fault == "seed":
            tape.start = dataclasses.replace(tape.start, seed=2)
        else:
            changed = tape.steps[3].result
            state = {name: value + np.float32(1e-6) for name, value in changed.observation.state.items()}
            observation = dataclasses.replace(changed.observation, state=state)
            other = {"state": {"observation": observation}, "reward": {"reward": changed.reward + 1e-6}}
            result = dataclasses.replace(changed, **other[fault])
            tape.steps[3] = dataclasses.replace(tape.steps[3], result=result)
        with (
            closing(make_env(CAPTURED)) as env,
            pytest.raises(ViewingError, match="--capture-video or --capt"),
        ):
            film_again(tape, env)


def test_outcomes_are_filmed_while_they_run_where_an_episode_cannot_be_repeated() -> None:
    for video, rrd, afterwards in [
        ("failures", "none", True),
        ("failures", "successes", True),
        ("failures", 1, False),
        ("all", "failures", False),
    ]:
        config = CaptureConfig(video=video, rrd=rrd)  # type: ignore[arg-type]
        assert config.films_afterwards("cpu") is afterwards
        assert not config.films_afterwards("gpu")
