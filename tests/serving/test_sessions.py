"""Sessions: slots, rows, frames in order, limits; and what a request must hold."""

from typing import Any, Literal

import numpy as np
import pytest

from tests.serving.served_policies import frame
from vla_eval.features import STATE_NAMES
from vla_eval.serving import sessions
from vla_eval.serving.observations import ObservationReader, RequestError, observation_reader
from vla_eval.serving.sessions import Session, SessionTable
from vla_eval.specs import PolicySpec
from vla_eval.tasks.interface import env_spec

LIMITS = ("MAX_SESSIONS_OF_CONNECTION", "MAX_SESSIONS_OF_ADDRESS", "MAX_SESSIONS")


def reader(*, end_effector: bool = False, states: tuple[str, ...] = ("qpos",)) -> ObservationReader:
    spec = PolicySpec(name="any", reads="last", cameras=("base_camera",), states=states, chunk_size=1)
    return observation_reader(spec, env_spec(), end_effector=end_effector)


class Clock:
    seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


class Table(SessionTable):
    """Notes which slots are to be forgotten."""

    def __init__(self, **options: Any) -> None:
        self.forgotten: list[int] = []
        super().__init__(reader(), task="any", forget=self.forgotten.append, **options)


def table(*, reads: Literal["last", "every"] = "every", n_rows: int = 2, clock: Any = None) -> Table:
    return Table(reads=reads, n_rows=n_rows, clock=clock or Clock())


def request(**fields: Any) -> dict[str, Any]:
    return frame(**{"observation/image": np.zeros((128, 128, 3), np.uint8), **fields})


def begun(
    sessions: SessionTable, name: str = "s", connection: int = 0, address: str = "here", **fields: Any
) -> Session:
    message = request(session_id=name, endpoint="reset", **fields)
    session = sessions.session(connection, message, address=address)
    sessions.begin(session, message)
    return session


class TestSlotsAndRows:
    def test_every_session_has_a_slot_of_its_own_and_a_freed_one_is_used_again(self) -> None:
        table_ = table()
        assert [begun(table_, name, connection=n % 2).slot for n, name in enumerate("abc")] == [0, 1, 2]
        table_.drop_connection(1)
        assert table_.forgotten == [1]
        assert begun(table_, "d").slot == 1

    def test_a_session_without_a_row_gets_the_one_with_the_fewest(self) -> None:
        table_ = table(n_rows=3)
        assert begun(table_, "a", row=1).row == 1
        assert [begun(table_, name).row for name in "bcde"] == [0, 2, 0, 1]

    def test_an_episode_is_what_the_client_says(self) -> None:
        start = begun(table(), task="T", seed=7, run=2, row=1, horizon_steps=60).episode
        assert start is not None
        assert (start.task, start.seed, start.run, start.row, start.horizon_steps) == ("T", 7, 2, 1, 60)
        assert start.instruction == "remember"

    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"row": 2}, "'row': expected a number from 0 to 1, found 2"),
            ({"seed": -1}, "'seed': expected a number from 0"),
            ({"seed": True}, "'seed'"),
            ({"session_id": 5}, "'session_id': expected text"),
            ({"prompt": " "}, "'prompt': expected the instruction"),
        ],
    )
    def test_a_wrong_field_is_refused(self, fields: dict[str, Any], message: str) -> None:
        table_, wrong = table(), request(endpoint="reset", **fields)
        with pytest.raises(RequestError, match=message):
            table_.begin(table_.session(0, wrong, address="here"), wrong)


class TestFrames:
    def test_an_inference_is_given_the_unread_frames_in_order(self) -> None:
        table_ = table()
        session = begun(table_)
        for step in range(3):
            table_.observe(session, request(step=step))
        assert [one.step for one in table_.window(session, request(step=3)).frames] == [0, 1, 2, 3]
        assert [one.step for one in table_.window(session, request(step=4)).frames] == [4]

    def test_a_policy_that_reads_the_last_frame_is_given_that_one(self) -> None:
        table_ = table(reads="last")
        session = begun(table_)
        table_.observe(session, request(step=0))
        assert [one.step for one in table_.window(session, request(step=1)).frames] == [1]

    def test_frames_without_a_step_are_counted(self) -> None:
        table_ = table()
        session = begun(table_)
        assert [table_.window(session, request()).last.step for _ in range(3)] == [0, 1, 2]

    def test_a_frame_of_the_past_is_refused(self) -> None:
        table_ = table()
        session = begun(table_)
        table_.observe(session, request(step=4))
        with pytest.raises(RequestError, match="step 4 after step 4"):
            table_.window(session, request(step=4))

    def test_a_reset_forgets_the_frames(self) -> None:
        table_ = table()
        session = begun(table_)
        table_.observe(session, request(step=0))
        begun(table_)
        assert len(table_.window(session, request(step=0)).frames) == 1

    def test_unread_frames_are_limited(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sessions, "MAX_UNREAD_FRAMES", 2)
        table_ = table()
        session = begun(table_)
        table_.observe(session, request())
        table_.observe(session, request())
        with pytest.raises(RequestError, match="at most 2 frames"):
            table_.observe(session, request())


class TestEpisodesWithoutReset:
    def test_the_first_request_and_another_instruction_begin_an_episode(self) -> None:
        table_ = table()
        session = table_.session(0, request(), address="here")
        assert table_.begins(session, request())
        table_.begin(session, request())
        assert not table_.begins(session, request())
        assert table_.begins(session, request(prompt="another"))

    def test_an_episode_that_the_server_lost_is_not_continued(self) -> None:
        table_ = table()
        with pytest.raises(RequestError, match="step 8 of an episode that the server does not have"):
            table_.begins(table_.session(0, request(), address="here"), request(step=8))

    def test_another_instruction_in_the_middle_of_an_episode_is_refused(self) -> None:
        table_ = table()
        with pytest.raises(RequestError, match="another instruction"):
            table_.begins(begun(table_), request(prompt="another"))


class TestAClientThatNeverResets:
    """Its episodes are one for the policy, which remembers all of them: one warning."""

    LONGEST_STEPS = 180  # of the paper's tasks: TakeItBack-v0

    def play(
        self, table_: SessionTable, session: Session, *, n_frames: int, observes: bool, says_step: bool
    ) -> None:
        for step in range(n_frames):
            message = request(**({"step": step} if says_step else {}))
            if observes and step % 8:
                table_.observe(session, message)
            else:
                table_.window(session, message)

    def begun_without_reset(self, table_: SessionTable, connection: int = 0) -> Session:
        session = table_.session(connection, request(), address="here")
        table_.begin(session, request())
        return session

    @pytest.mark.parametrize("observes", [False, True])
    @pytest.mark.parametrize("says_step", [False, True])
    @pytest.mark.parametrize("resets_once", [False, True])
    def test_it_is_warned_of_once_after_more_frames_than_the_longest_episode_has(
        self, observes: bool, says_step: bool, resets_once: bool, caplog: pytest.LogCaptureFixture
    ) -> None:
        table_ = table()
        session = begun(table_) if resets_once else self.begun_without_reset(table_)
        self.play(table_, session, n_frames=self.LONGEST_STEPS + 1, observes=observes, says_step=says_step)
        assert not caplog.records  # the frame after the last action is the episode's, too
        message = request(step=self.LONGEST_STEPS + 1)
        for _ in range(3):
            table_.window(session, message)
            message["step"] += 1
        other = self.begun_without_reset(table_, connection=1)
        self.play(table_, other, n_frames=self.LONGEST_STEPS + 5, observes=observes, says_step=says_step)

        (record,) = caplog.records
        said = record.getMessage()
        assert record.levelname == "WARNING" and "'reset' before each episode" in said
        assert f"connection 0 from here, session {'s' if resets_once else None}" in said.replace("'s'", "s")
        assert f"step {self.LONGEST_STEPS + 1} of one episode, expected at most {self.LONGEST_STEPS}" in said

    @pytest.mark.parametrize(
        ("reads", "n_episodes", "horizon_steps"), [("last", 1, None), ("every", 5, None), ("every", 1, 400)]
    )
    def test_no_other_client_is(
        self,
        reads: Literal["last", "every"],
        n_episodes: int,
        horizon_steps: int | None,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        """A policy that remembers nothing; a reset before each episode; a long episode that is announced."""
        table_ = table(reads=reads)
        for _ in range(n_episodes):
            session = begun(table_, **({} if horizon_steps is None else {"horizon_steps": horizon_steps}))
            n_frames = self.LONGEST_STEPS if n_episodes > 1 else 401
            self.play(table_, session, n_frames=n_frames, observes=True, says_step=True)
        assert not caplog.records

    def test_an_episode_longer_than_announced_is_warned_of(self, caplog: pytest.LogCaptureFixture) -> None:
        table_ = table()
        self.play(table_, begun(table_, horizon_steps=60), n_frames=62, observes=False, says_step=False)
        assert "step 61 of one episode, expected at most 60 (its 'horizon_steps')" in caplog.text

    def test_another_instruction_or_connection_begins_an_episode_without_reset(
        self, caplog: pytest.LogCaptureFixture
    ) -> None:
        table_ = table()
        for connection in range(3):
            session = self.begun_without_reset(table_, connection)
            self.play(table_, session, n_frames=100, observes=False, says_step=False)
            other = request(prompt="another")
            assert table_.begins(session, other)
            table_.begin(session, other)
            self.play(table_, session, n_frames=100, observes=False, says_step=False)
        assert not caplog.records


class TestLimits:
    def test_an_idle_session_is_dropped_and_must_begin_again(self) -> None:
        clock = Clock()
        table_ = table(clock=clock)
        idle, busy = begun(table_, "idle"), begun(table_, "busy")
        busy.n_pending = 1
        clock.seconds = 601.0
        table_.drop_idle(600.0)
        assert table_.forgotten == [idle.slot]
        with pytest.raises(RequestError, match="'idle' was dropped, since no message came for too long"):
            table_.session(0, request(session_id="idle"), address="here")
        assert begun(table_, "idle").episode is not None

    @pytest.mark.parametrize("limit", LIMITS)
    def test_one_session_too_many_takes_the_place_of_the_idlest_of_its_connection(
        self, limit: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sessions, limit, 4)
        clock = Clock()
        table_ = table(clock=clock)
        others = [] if limit == "MAX_SESSIONS_OF_CONNECTION" else [begun(table_, "other", connection=1)]
        mine = []
        for name in "abcd"[len(others) :]:
            clock.seconds += 1
            mine.append(begun(table_, name))
        mine[0].n_pending = 1  # the oldest, but not idle
        clock.seconds += 1
        new = begun(table_, "new")
        assert table_.forgotten == [mine[1].slot] == [new.slot] and len(table_) == 4
        with pytest.raises(
            RequestError, match=f"{mine[1].name!r} was dropped, since it was the idlest of more"
        ):
            table_.session(0, request(session_id=mine[1].name), address="here")
        for one in (mine[0], *mine[2:], new, *others):
            message = request(session_id=one.name)
            assert table_.session(one.connection, message, address="here") is one

    @pytest.mark.parametrize("limit", LIMITS)
    def test_a_session_too_many_is_refused_if_none_of_its_connection_is_idle(
        self, limit: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sessions, limit, 1)
        table_ = table()
        begun(table_, "a").n_pending = 1
        with pytest.raises(RequestError, match="at most 1 sessions of a"):
            begun(table_, "b")
        if limit != "MAX_SESSIONS_OF_CONNECTION":
            with pytest.raises(RequestError, match="at most 1 sessions of a"):
                begun(table_, "b", connection=1)  # whose own is idle or not, it has none
        assert table_.forgotten == [] and len(table_) == 1

    @pytest.mark.slow
    def test_no_machine_takes_the_place_of_others_however_many_connections_it_opens(self) -> None:
        table_ = table()
        other = begun(table_, "other", connection=-1, address="there")
        with pytest.raises(RequestError, match="at most 3072 sessions of a machine"):
            for connection in range(sessions.MAX_SESSIONS):
                table_.session(connection, request(), address="here")
        for n in range(sessions.MAX_SESSIONS):  # one that has a connection keeps to its own
            begun(table_, f"s{n}", connection=0)
        assert len(table_) == sessions.MAX_SESSIONS_OF_ADDRESS + 1
        assert other.slot not in table_.forgotten
        for n in range(sessions.MAX_SESSIONS - len(table_)):
            table_.session(10_000 + n, request(), address="there")
        assert other.slot not in table_.forgotten and len(table_) == sessions.MAX_SESSIONS

    def test_the_names_of_dropped_sessions_are_limited(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sessions, "MAX_SESSIONS_OF_CONNECTION", 1)
        monkeypatch.setattr(sessions, "MAX_DROPPED_NAMES", 3)
        table_ = table()
        for n in range(9):
            begun(table_, f"s{n}")
        assert sum(len(names) for names in table_._dropped.values()) == 3
        table_.drop_connection(0)
        assert not table_._dropped and len(table_) == 0


class TestObservations:
    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            (
                {"observation/image": None},
                r"no 'observation/image': expected an image \(128, 128, 3\)",
            ),
            (
                {"observation/image": np.zeros((64, 128, 3), np.uint8)},
                r"found an array \(64, 128, 3\)",
            ),
            ({"observation/image": np.zeros((128, 128, 3), np.float32)}, "found an array .* float32"),
            ({"observation/state": np.zeros(8, np.float32)}, r"expected 9 numbers \(qpos\), found 8 numbers"),
            ({"observation/state": np.zeros(9, np.int64)}, "float32; found an array .* int64"),
            ({"observation/state": np.full(9, np.nan, np.float32)}, "expected finite numbers"),
            ({"observation/state": [0.0] * 9}, "expected an array"),
        ],
    )
    def test_what_does_not_fit_is_refused(self, fields: dict[str, Any], message: str) -> None:
        with pytest.raises(RequestError, match=message):
            reader().read(request(**fields), step=0)

    def test_a_mistyped_key_is_named(self) -> None:
        mistyped = request()
        mistyped["observation/imge"] = mistyped.pop("observation/image")
        with pytest.raises(RequestError, match="Did you mean 'observation/imge'"):
            reader().read(mistyped, step=0)

    def test_the_25_numbers_are_pose_positions_and_velocities(self) -> None:
        read = reader(states=("tcp_pose", "qpos", "qvel"), end_effector=True)
        assert read.state_layouts == STATE_NAMES
        numbers = np.arange(25, dtype=np.float64)
        numbers[3:7] = 0, 1, 0, 0  # the quaternion
        state = read.read(request(**{"observation/state": numbers}), step=0).state
        assert {name: (values[0], len(values)) for name, values in state.items()} == {
            "tcp_pose": (0, 7),
            "qpos": (7, 9),
            "qvel": (16, 9),
        }
        assert all(values.dtype == np.float32 for values in state.values())

    def test_ten_numbers_are_the_end_effector_for_a_policy_that_reads_it(self) -> None:
        numbers = np.array([1, 2, 3, 0, 1, 0, 1, 0, 0, 4], dtype=np.float32)
        ten = request(**{"observation/state": numbers})
        read = reader(states=("tcp_pose", "qpos", "qvel"), end_effector=True)
        assert read.read(ten, step=0).state["eef"].tolist() == numbers.tolist()
        with pytest.raises(RequestError, match=r"expected 25 numbers \(joints\), found 10"):
            reader(states=("tcp_pose", "qpos", "qvel")).read(ten, step=0)
