"""The loop of one batch of episodes, on the fake simulator."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import pytest

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.core import (
    ActionChunk,
    EpisodeStart,
    FloatArray,
    ObservationWindow,
    Stage,
    StepResult,
)
from vla_eval.envs.fake import FakeEnv
from vla_eval.errors import (
    InvalidActionError,
    MissingInstructionError,
    SimulationError,
    SpecMismatchError,
)
from vla_eval.records import EpisodeRecord
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import PolicySpec
from vla_eval.tasks.objects.layout import places_from_right

TASK = "RememberColor3-v0"
HORIZON = 60
ALL_CAMERAS = ("base_camera", "hand_camera")


class Pusher:
    """Draws actions from a generator of the episode's seed; remembers the windows it was given."""

    def __init__(
        self,
        *,
        reads: Literal["last", "every"] = "last",
        cameras: tuple[str, ...] = (),
        chunk_size: int = 1,
        privileged: bool = False,
    ) -> None:
        self.spec = PolicySpec(
            name="pusher",
            reads=reads,
            cameras=cameras,
            states=("qpos",),
            chunk_size=chunk_size,
            privileged=privileged,
        )
        self.windows: list[ObservationWindow] = []
        self._rng: dict[int, np.random.Generator] = {}

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        self._rng.update({episode.slot: np.random.default_rng(episode.seed) for episode in episodes})

    def act(self, window: ObservationWindow) -> ActionChunk:
        self.windows.append(window)
        return self.chunk(window)

    def chunk(self, window: ObservationWindow) -> ActionChunk:
        drawn = self._rng[window.slot].uniform(-1, 1, (self.spec.chunk_size, 7))
        return ActionChunk(actions=drawn.astype(np.float32))


class Reacher(Pusher):
    """Goes to the right candidate as soon as the choice can be made."""

    def chunk(self, window: ObservationWindow) -> ActionChunk:
        state = window.last.privileged
        assert state is not None
        assert state.target is not None
        action = np.zeros((self.spec.chunk_size, 7), dtype=np.float32)
        if state.phase == "response":
            gap = state.candidate_positions_m[state.target] - state.tcp_position_m
            action[0, :3] = np.clip(gap / 0.039, -1, 1)
        return ActionChunk(actions=action)


class Fixed(Pusher):
    """Returns what it was given, whatever it is."""

    def __init__(self, answer: Any, *, chunk_size: int = 2) -> None:
        super().__init__(chunk_size=chunk_size)
        self.answer = answer

    def chunk(self, window: ObservationWindow) -> ActionChunk:
        answer: ActionChunk = self.answer
        return answer


def start(seed: int = 1, *, slot: int = 0, instruction: str = "do it") -> EpisodeStart:
    return EpisodeStart(
        slot=slot, task=TASK, seed=seed, run=0, instruction=instruction, horizon_steps=HORIZON
    )


def env_for(policy: Pusher) -> FakeEnv:
    spec = policy.spec
    return FakeEnv(EnvSettings(task=TASK, simulator="fake", cameras=spec.cameras, privileged=spec.privileged))


def run(
    policy: Pusher, *, n_action_steps: int = 1, env: FakeEnv | None = None, **settings: Any
) -> EpisodeRecord:
    chunking = ChunkingSpec(n_action_steps=n_action_steps)
    (record,) = rollout(
        env or env_for(policy), policy, [start()], RolloutSettings(chunking=chunking, **settings)
    )
    return record


class TestFrames:
    def test_a_last_only_policy_gets_one_frame_and_nothing_else_is_rendered(self) -> None:
        policy = Pusher(cameras=ALL_CAMERAS, chunk_size=8)
        env = env_for(policy)

        record = run(policy, n_action_steps=8, env=env)

        # Inferences at 0, 8, …, 56: eight of them, and a picture for each.
        assert [window.last.step for window in policy.windows] == list(range(0, HORIZON, 8))
        assert all(
            len(window.frames) == 1 and set(window.last.images) == set(ALL_CAMERAS)
            for window in policy.windows
        )
        assert env.n_renders == 8
        assert (record.n_inferences, record.n_frames) == (8, 8)

    def test_an_every_frame_policy_gets_all_frames_oldest_first(self) -> None:
        policy = Pusher(reads="every", cameras=ALL_CAMERAS, chunk_size=8)
        env = env_for(policy)

        record = run(policy, n_action_steps=8, env=env)

        assert env.n_renders == 57  # nothing after the last inference: nobody would look at it
        steps = [frame.step for window in policy.windows for frame in window.frames]
        # The frame of reset, then all up to the last inference at step 56: 57 frames.
        assert steps == list(range(57))
        assert all(frame.images for window in policy.windows for frame in window.frames)
        assert record.n_frames == 57

    def test_a_policy_without_cameras_causes_no_rendering(self) -> None:
        policy = Pusher()
        env = env_for(policy)

        run(policy, env=env)

        assert env.n_renders == 0

    def test_eager_rendering_changes_no_result_and_no_picture(self) -> None:
        lazy, eager = (Pusher(cameras=ALL_CAMERAS, chunk_size=4) for _ in range(2))

        lazy_record = run(lazy, n_action_steps=4)
        eager_record = run(eager, n_action_steps=4, eager_rendering=True)

        assert lazy_record == eager_record
        for one, other in zip(lazy.windows, eager.windows, strict=True):
            for camera in ALL_CAMERAS:
                np.testing.assert_array_equal(one.last.images[camera], other.last.images[camera])

    def test_an_observer_that_wants_images_gets_them(self) -> None:
        class Camera:
            def __init__(self) -> None:
                self.steps_with_images: list[int] = []

            def wants_images(self, step: int) -> bool:
                return step in (0, 7, HORIZON)

            def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
                self._take(result)

            def on_inference(self, episode: EpisodeStart, step: int, chunk: ActionChunk) -> None:
                pass

            def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
                self._take(result)

            def _take(self, result: StepResult) -> None:
                if result.observation.images:
                    self.steps_with_images.append(result.observation.step)

        camera, policy = Camera(), Pusher(cameras=("base_camera",), chunk_size=HORIZON)
        settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=HORIZON))

        rollout(env_for(policy), policy, [start()], settings, observers=[camera])

        assert camera.steps_with_images == [0, 7, HORIZON]


class TestIndependence:
    def test_slots_and_their_order_do_not_matter(self) -> None:
        settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=1))

        def records(order: list[int]) -> dict[int, EpisodeRecord]:
            policy = Pusher()
            episodes = [start(seed, slot=slot) for slot, seed in enumerate(order)]
            return {r.seed: r for r in rollout(env_for(policy), policy, episodes, settings)}

        alone = {seed: records([seed])[seed] for seed in (1, 2, 3)}

        assert records([1, 2, 3]) == alone
        assert records([3, 1, 2]) == alone

    def test_a_batch_policy_gives_the_same_records_as_one_by_one(self) -> None:
        class Batched(Pusher):
            def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
                return [self.chunk(window) for window in windows]

        settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=1))
        episodes = [start(1, slot=0), start(2, slot=1)]

        one_by_one, batched = Pusher(), Batched()

        assert rollout(env_for(batched), batched, episodes, settings) == rollout(
            env_for(one_by_one), one_by_one, episodes, settings
        )

    def test_other_actions_give_another_digest(self) -> None:
        still = Fixed(ActionChunk(actions=np.zeros((2, 7), dtype=np.float32)))

        assert run(still).trajectory_sha256 != run(Pusher()).trajectory_sha256


class TestOutcome:
    def test_success_is_taken_down_with_its_step(self) -> None:
        record = run(Reacher(privileged=True))

        assert record.outcome == "success"
        assert record.success_once is record.success_at_end is record.first_choice_success is True
        assert record.first_choice == record.target
        assert record.n_wrong_choices == 0
        # The choice can be made from step 10 on; 0.298 m down at 0.039 m per step need 8 steps at least.
        assert record.success_step is not None
        assert record.success_step > 10 + 6
        assert record.n_steps == HORIZON

    def test_stop_at_success_ends_the_episode_there(self) -> None:
        whole = run(Reacher(privileged=True))
        stopped = run(Reacher(privileged=True), stop_at_success=True)

        assert stopped.n_steps == stopped.success_step == whole.success_step
        assert stopped.success_at_end is None

    def test_steps_after_success_are_executed_before_the_episode_stops(self) -> None:
        stopped = run(Reacher(privileged=True), stop_at_success=True, steps_after_success=3)

        assert stopped.success_step is not None
        assert stopped.n_steps == stopped.success_step + 3

    def test_a_failure_has_no_success_step_and_no_choice(self) -> None:
        record = run(Fixed(ActionChunk(actions=np.zeros((2, 7), dtype=np.float32))))

        assert record.outcome == "failure"
        assert record.success_step is None
        assert record.first_choice is None
        assert record.first_choice_success is False

    def test_clipped_steps_are_counted(self) -> None:
        chunk = np.zeros((2, 7), dtype=np.float32)
        chunk[0, 0] = 1.5  # every second step

        assert run(Fixed(ActionChunk(actions=chunk)), n_action_steps=2).n_clipped_steps == HORIZON // 2

    def test_before_the_first_chunk_arrives_the_arm_holds(self) -> None:
        policy = Fixed(ActionChunk(actions=np.full((6, 7), 0.5, dtype=np.float32)), chunk_size=6)
        env = env_for(policy)
        chunking = ChunkingSpec(n_action_steps=1, delay=3)

        (record,) = rollout(env, policy, [start()], RolloutSettings(chunking=chunking))

        # Three steps of holding, then 57 steps of 0.5 * 0.039 m upwards from 0.318 m.
        assert env.reset({1: 1}, render=False)[1].observation.state["tcp_pose"][2] == pytest.approx(0.318)
        height = env.step({0: np.zeros(7, dtype=np.float32)}, render=frozenset())[0].observation.state[
            "tcp_pose"
        ][2]
        assert height == pytest.approx(0.318 + 57 * 0.5 * 0.039, abs=1e-5)
        # Inferences at 0, 3, … 57; each chunk is executed from 3 to 5 steps after its observation.
        assert (record.n_held_steps, record.n_inferences, record.mean_age_steps) == (3, 20, 4.0)
        assert record.delay_steps is None


class TestRefusals:
    @pytest.mark.parametrize(
        ("answer", "found"),
        [
            (ActionChunk(actions=np.zeros((3, 7), dtype=np.float32)), r"shape \(3, 7\)"),
            (ActionChunk(actions=np.zeros((2, 6), dtype=np.float32)), r"shape \(2, 6\)"),
            (ActionChunk(actions=np.zeros((2, 7))), "dtype float64"),  # type: ignore[arg-type]
            (ActionChunk(actions=np.full((2, 7), np.nan, dtype=np.float32)), "nan at row 0, dimension 'dx'"),
            (np.zeros((2, 7), dtype=np.float32), "ndarray"),
            (None, "NoneType"),
        ],
    )
    def test_what_is_no_finite_chunk_is_refused(self, answer: object, found: str) -> None:
        with pytest.raises(InvalidActionError, match=rf"seed 1, inference at step 0: .*found {found}"):
            run(Fixed(answer))

    def test_an_episode_without_instruction_is_refused(self) -> None:
        policy = Pusher()
        settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=1))

        with pytest.raises(MissingInstructionError, match=f"{TASK}, seed 1: the instruction is empty"):
            rollout(env_for(policy), policy, [start(instruction=" ")], settings)

    def test_a_simulation_that_diverged_is_no_failure_of_the_policy(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        policy = Pusher()
        env = env_for(policy)
        plain_step = env.step

        def diverging(actions: Any, *, render: frozenset[int]) -> Any:
            results = plain_step(actions, render=render)
            return {slot: dataclasses.replace(r, reward=float("nan")) for slot, r in results.items()}

        monkeypatch.setattr(env, "step", diverging)
        with pytest.raises(SimulationError, match="seed 1, step 1: expected a finite 'reward', found nan"):
            run(policy, env=env)

    def test_a_camera_that_is_not_there_is_refused_with_the_closest_name(self) -> None:
        policy = Pusher(cameras=("wrist_camera",))
        env = FakeEnv(EnvSettings(task=TASK, simulator="fake"))

        with pytest.raises(
            SpecMismatchError, match=r"needs the camera 'wrist_camera'.*Did you mean 'base_camera'"
        ):
            run(policy, env=env)

    def test_chunks_too_short_for_the_interval_are_refused(self) -> None:
        with pytest.raises(SpecMismatchError, match="predicts chunks of 1 actions"):
            run(Pusher(chunk_size=1), n_action_steps=2)


def test_the_heartbeat_names_each_stage_before_it_begins() -> None:
    stages: list[Stage] = []
    policy = Pusher(chunk_size=30)
    settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=30))

    rollout(env_for(policy), policy, [start()], settings, heartbeat=stages.append)

    # One reset, inferences at 0 and 30, and 60 control steps.
    assert stages == ["reset", "inference", *["step"] * 30, "inference", *["step"] * 30]


def test_records_are_plain_values() -> None:
    record = run(Reacher(privileged=True))

    assert EpisodeRecord.from_json(record.to_json(), where="here") == record
    assert all(type(value).__module__ == "builtins" for value in dataclasses.asdict(record).values())


class TestWhatIsRecordedOfTheChoice:
    def test_places_are_counted_from_the_robots_right(self) -> None:
        # Seen from the robot, which looks along +x, -y is on the right; the third thing lies farthest there.
        positions_m = np.array([[0.0, 0.1], [0.0, 0.0], [0.0, -0.1]])
        assert places_from_right(positions_m) == (2, 1, 0)

    def test_the_first_choice_of_a_policy_that_remembers_lies_where_the_target_does(self) -> None:
        policy = Reacher(privileged=True)
        env = env_for(policy)
        (result,) = env.reset({0: 1}, render=False).values()
        places = result.status.candidate_places
        assert result.status.target is not None
        record = run(policy, env=env)
        assert record.target_place == record.first_choice_place == places[result.status.target]

    def test_the_reach_is_the_distance_from_the_start_and_not_the_way(self) -> None:
        # Along x there and back again: 10 steps of 0.039 m each way; it was never farther than 0.39 m.
        class ThereAndBack(Pusher):
            def chunk(self, window: ObservationWindow) -> ActionChunk:
                action = np.zeros((1, 7), dtype=np.float32)
                action[0, 0] = {True: 1.0, False: -1.0}[window.last.step < 10] * (window.last.step < 20)
                return ActionChunk(actions=action)

        assert run(ThereAndBack()).tcp_reach_m == pytest.approx(0.39, abs=1e-6)


def test_a_policy_is_given_only_what_it_declares_whatever_observers_ask_for() -> None:
    policy = Pusher(cameras=("base_camera",))
    env = FakeEnv(EnvSettings(task=TASK, simulator="fake", cameras=ALL_CAMERAS, privileged=True))
    run(policy, env=env)
    assert {tuple(frame.images) for window in policy.windows for frame in window.frames} == {("base_camera",)}
    assert all(frame.privileged is None for window in policy.windows for frame in window.frames)
