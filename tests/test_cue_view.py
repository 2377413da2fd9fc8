"""What a policy is given to see of the cue, on the fake simulator: the first rows of an image show it."""

from typing import Any

import numpy as np
import pytest

from tests.test_rollout import ALL_CAMERAS, Pusher
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.core import EpisodeStart, FloatArray, ImageArray, StepResult
from vla_eval.cue_view import GREY, CueView, CueViewKind, CueViewSettings, PixelBox
from vla_eval.envs.fake import CUE_ROWS, FakeEnv
from vla_eval.errors import SpecMismatchError, TaskArgumentError
from vla_eval.records import EpisodeRecord
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.task_state import Phase

CAMERA = "base_camera"
VIEWS: tuple[CueViewKind, ...] = ("first_frame", "hidden", "hidden_elsewhere", "hidden_later")


class Watcher:
    """Keeps the images that were rendered."""

    def __init__(self) -> None:
        self.images: list[ImageArray] = []

    def wants_images(self, step: int) -> bool:
        return True

    def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
        self.images.append(result.observation.images[CAMERA])

    def on_inference(self, *_: Any) -> None:
        pass

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        self.images.append(result.observation.images[CAMERA])


def play(
    kind: CueViewKind, *, n_action_steps: int = 1, observers: tuple[Watcher, ...] = (), **settings: Any
) -> tuple[EpisodeRecord, dict[int, ImageArray]]:
    """The record, and step -> image that the policy was given."""
    kwargs = {"cue_steps": 5, "delay_steps": 5, "cue_after_steps": settings.pop("after", 0)}
    env = FakeEnv(EnvSettings(task="RememberColor3-v0", simulator="fake", cameras=ALL_CAMERAS, kwargs=kwargs))
    policy = Pusher(cameras=ALL_CAMERAS, chunk_size=n_action_steps)
    start = EpisodeStart(slot=0, task="RememberColor3-v0", seed=3, run=0, instruction="go", horizon_steps=30)
    view = CueViewSettings(kind=kind, begins_at=kwargs["cue_after_steps"])
    chunking = ChunkingSpec(n_action_steps=n_action_steps)
    (record,) = rollout(
        env,
        policy,
        [start],
        RolloutSettings(chunking=chunking, cue_view=view, **settings),
        observers=observers,
    )
    return record, {window.last.step: window.last.images[CAMERA] for window in policy.windows}


def is_grey(image: ImageArray) -> Any:
    return (image == GREY).all(axis=-1)


@pytest.mark.parametrize("kind", VIEWS)
def test_only_images_of_the_policy_change(kind: CueViewKind) -> None:
    plain, watcher = Watcher(), Watcher()
    drawn, _ = play("as_shown", observers=(plain,))
    record, seen = play(kind, observers=(watcher,))
    assert record == drawn  # the policy draws its actions, whatever it sees
    for one, other in zip(plain.images, watcher.images, strict=True):
        np.testing.assert_array_equal(one, other)
    changed = {step for step, image in seen.items() if not np.array_equal(image, plain.images[step])}
    in_delay = kind == "hidden_later"
    assert changed == set(range(1 if kind == "first_frame" else 0, 5)) if not in_delay else set(range(5, 10))


def test_the_first_frame_of_a_late_cue_is_rendered_even_if_no_inference_falls_on_it() -> None:
    watcher = Watcher()
    _, seen = play("first_frame", n_action_steps=2, after=3, observers=(watcher,))
    for step in (4, 6):  # the cue is shown at steps 3 to 7
        np.testing.assert_array_equal(seen[step], watcher.images[3])
    for step in (0, 2, 8):
        np.testing.assert_array_equal(seen[step], watcher.images[step])


@pytest.mark.parametrize("kind", VIEWS)
def test_rendering_each_frame_changes_nothing_of_what_is_seen(kind: CueViewKind) -> None:
    lazy, seen = play(kind, n_action_steps=3)
    eager, also_seen = play(kind, n_action_steps=3, eager_rendering=True)
    assert lazy == eager
    for step, image in seen.items():
        np.testing.assert_array_equal(image, also_seen[step])


def test_the_same_number_of_pixels_is_grey_elsewhere_and_none_of_the_cue() -> None:
    _, hidden = play("hidden")
    _, elsewhere = play("hidden_elsewhere")
    assert is_grey(hidden[0])[:CUE_ROWS].all()
    assert not is_grey(elsewhere[0])[:CUE_ROWS].any()
    assert is_grey(elsewhere[0]).sum() == is_grey(hidden[0]).sum()


def test_a_cue_that_takes_more_than_half_of_an_image_cannot_be_hidden_elsewhere() -> None:
    boxes = {CAMERA: (PixelBox(0, 70, 0, 128),)}
    view = CueView(settings=CueViewSettings(kind="hidden_elsewhere"), locate=lambda: boxes)
    phase: Phase = "cue"
    env = FakeEnv(EnvSettings(task="RememberColor3-v0", simulator="fake", cameras=ALL_CAMERAS))
    shown = env.reset({0: 3}, render=True)[0].observation
    with pytest.raises(TaskArgumentError, match="the cue takes 55% of the image"):  # 70 of 128 rows
        view.seen(shown, phase)


class WithoutPlaces:
    """An environment that does not know where the cue is."""

    def __init__(self, env: FakeEnv) -> None:
        self.spec = env.spec


def test_an_environment_that_cannot_locate_the_cue_is_refused() -> None:
    env: Any = WithoutPlaces(FakeEnv(EnvSettings(task="RememberColor3-v0", simulator="fake")))
    settings = RolloutSettings(
        chunking=ChunkingSpec(n_action_steps=1), cue_view=CueViewSettings(kind="hidden")
    )
    with pytest.raises(SpecMismatchError, match="cannot tell where in its images the cue is"):
        rollout(env, Pusher(cameras=ALL_CAMERAS), [], settings)
