"""A policy behind a socket: what is sent, what is taken for an answer, and what is refused."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.wire.small_servers import CHUNK_SIZE, SmallServer, serving, some_actions
from vla_eval.chunking import ChunkingSettings
from vla_eval.config.environment import EnvSettings
from vla_eval.config.files import digest_of
from vla_eval.core import EpisodeStart, Observation, ObservationWindow
from vla_eval.envs.fake import FakeEnv
from vla_eval.errors import (
    InvalidActionError,
    RecipeError,
    RemoteChangedError,
    RemoteConnectionError,
    RemoteReplyError,
    VlaEvalError,
)
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.remote.policy import RemotePolicy, make_remote
from vla_eval.records import EpisodeRecord
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.wire.metadata import ServerMetadata

SHORT = {"horizon_steps": 8, "delay_steps": 1}
TASK = "RememberColor3-v0"
IMAGE = {"base_camera": {"key": "observation/image"}}


def make_env(n_slots: int = 1, cameras: tuple[str, ...] = ()) -> FakeEnv:
    return FakeEnv(EnvSettings(task=TASK, kwargs=SHORT, n_slots=n_slots, cameras=cameras))


@contextlib.contextmanager
def remote(
    server: SmallServer,
    *,
    n_action_steps: int = 1,
    n_slots: int = 1,
    chunking: ChunkingSettings = ChunkingSettings(),  # noqa: B008  # frozen
    **args: Any,
) -> Iterator[RemotePolicy]:
    """A policy at this server."""
    context = PolicyContext(
        name="remote",
        env=make_env().spec,
        chunking=chunking.at(n_action_steps),
        n_candidates=3,
        n_slots=n_slots,
    )
    with serving(server) as url:
        policy = make_remote(context, url=url, **args)
        try:
            yield policy
        finally:
            policy.close()


def starts(*seeds: int) -> list[EpisodeStart]:
    return [
        EpisodeStart(
            slot=slot, task=TASK, seed=seed, run=0, instruction="touch it", horizon_steps=8, row=slot
        )
        for slot, seed in enumerate(seeds)
    ]


def run(policy: RemotePolicy, *seeds: int, n_action_steps: int = 1) -> list[EpisodeRecord]:
    settings = RolloutSettings(chunking=ChunkingSettings().at(n_action_steps))
    return rollout(make_env(len(seeds), policy.spec.cameras), policy, starts(*seeds), settings)


def refusal(server: SmallServer, **kwargs: Any) -> str:
    """Return why no policy can be made for this server."""
    with pytest.raises(VlaEvalError) as error, remote(server, **kwargs):
        pass
    return str(error.value)


# ------------------------------------------------------------------------------------------ a server of ours


def test_one_message_per_inference_and_a_reset_with_all_that_an_episode_is() -> None:
    server = SmallServer()
    with remote(server, n_action_steps=4) as policy:
        run(policy, 7, n_action_steps=4)
    reset, *infers = server.requests
    assert {
        key: reset[key] for key in ("endpoint", "task", "seed", "run", "row", "horizon_steps", "prompt")
    } == {
        **{"endpoint": "reset", "task": TASK, "seed": 7, "run": 0, "row": 0, "horizon_steps": 8},
        "prompt": "touch it",
    }
    assert [(one["endpoint"], one["step"]) for one in infers] == [("infer", 0), ("infer", 4)]
    assert all(one["prompt"] == "touch it" for one in infers)
    assert {one["session_id"] for one in server.requests} == {reset["session_id"]}


def test_the_state_is_the_25_numbers_of_the_layout_joints() -> None:
    server = SmallServer()
    with remote(server) as policy:
        run(policy, 7)
    env = make_env()
    state = env.reset({0: 7}, render=False)[0].observation.state
    sent = server.requests[1]["observation/state"]
    assert sent.dtype == np.float32
    np.testing.assert_array_equal(sent, np.concatenate([state["tcp_pose"], state["qpos"], state["qvel"]]))


def test_what_is_executed_is_what_the_server_answered() -> None:
    with remote(SmallServer(), n_action_steps=4) as policy:
        (record,) = run(policy, 7, n_action_steps=4)
    with remote(SmallServer(), n_action_steps=4, n_slots=2) as policy:
        pair = run(policy, 3, 7, n_action_steps=4)
    assert pair[1].trajectory_sha256 == record.trajectory_sha256
    with remote(SmallServer()) as policy:
        policy.reset(starts(7))
        chunk = policy.act(window(0))
    np.testing.assert_array_equal(chunk.actions, some_actions(7, 0))


def window(step: int, *, slot: int = 0, n_frames: int = 1) -> ObservationWindow:
    sizes = {"tcp_pose": 7, "qpos": 9, "qvel": 9}
    state = {name: np.ones(size, dtype=np.float32) for name, size in sizes.items()}
    state["tcp_pose"][3:] = 0.5  # a quaternion of length 1
    frames = tuple(Observation(step=step - n_frames + 1 + i, images={}, state=state) for i in range(n_frames))
    return ObservationWindow(slot=slot, frames=frames)


def test_all_requests_are_sent_before_the_first_answer_is_awaited() -> None:
    server, asked = SmallServer(), []

    def answer_both_at_once_the_later_first(request: dict[str, Any]) -> Any:
        if request["endpoint"] != "infer":
            return server.usual_answer(request)
        asked.append(request)
        return [server.usual_answer(one) for one in reversed(asked)] if len(asked) == 2 else None

    server.answer = answer_both_at_once_the_later_first
    with remote(server, n_slots=2, timeout_seconds=5.0) as policy:
        policy.reset(starts(3, 7))
        chunks = policy.act_batch([window(0, slot=0), window(0, slot=1)])
    np.testing.assert_array_equal(chunks[0].actions, some_actions(3, 0))
    np.testing.assert_array_equal(chunks[1].actions, some_actions(7, 0))
    assert server.n_connections == 1


def test_frames_between_inferences_are_observed_without_an_answer() -> None:
    server = SmallServer(needs_every_frame=True)
    with remote(server, n_action_steps=4) as policy:
        assert policy.spec.reads == "every"
        run(policy, 7, n_action_steps=4)
    assert [(one["endpoint"], one["step"]) for one in server.requests] == [
        *[("reset", 0), ("infer", 0), ("observe", 1), ("observe", 2), ("observe", 3), ("infer", 4)],
    ]


def test_the_image_is_sent_as_it_is_where_the_sizes_agree() -> None:
    camera = make_env().spec.cameras[0]
    says = {"key": "observation/image", "height_px": camera.height_px, "width_px": camera.width_px}
    server = SmallServer(cameras={"base_camera": says})
    with remote(server) as policy:
        run(policy, 7)
    image = make_env(cameras=("base_camera",)).reset({0: 7}, render=True)[0].observation.images["base_camera"]
    np.testing.assert_array_equal(server.requests[1]["observation/image"], image)


@pytest.mark.parametrize("how", ["pad", "plain"])
def test_the_image_is_resized_to_what_the_server_says(how: str) -> None:
    says = {"key": "observation/image", "height_px": 20, "width_px": 50}
    server = SmallServer(cameras={"base_camera": says})
    with remote(server, cameras={"base_camera": {"key": "observation/image", "resize": how}}) as policy:
        run(policy, 7)
    assert server.requests[1]["observation/image"].shape == (20, 50, 3)


# ------------------------------------------------------------------------------------------ other servers


PLAIN = {"cameras": {}, "state": {"observation/state": "libero"}, "chunk_size": CHUNK_SIZE}


def plain_server(**metadata: Any) -> SmallServer:
    """A server that says nothing of itself, as openpi's."""
    server = SmallServer()
    server.metadata = metadata
    return server


def test_a_plain_server_gets_nothing_but_the_observation() -> None:
    server = plain_server()
    with remote(server, n_action_steps=4, **PLAIN) as policy:
        run(policy, 7, n_action_steps=4)
    assert [sorted(one) for one in server.requests] == [["observation/state", "prompt"]] * 2
    assert server.requests[0]["observation/state"].shape == (8,)


def test_each_slot_has_a_connection_of_its_own_where_a_session_is_a_connection() -> None:
    server = plain_server()
    with remote(server, n_slots=2, **PLAIN) as policy:
        run(policy, 3, 7)
    assert server.n_connections == 2


@pytest.mark.parametrize("as_what", [np.float64, list])
def test_actions_may_be_of_double_precision_or_a_list(as_what: Any) -> None:
    server = plain_server()
    actions = some_actions(0, 0)
    sent = actions.tolist() if as_what is list else actions.astype(as_what)
    server.answer = lambda request: {"actions": sent}
    with remote(server, **PLAIN) as policy:
        policy.reset(starts(7))
        chunk = policy.act(window(0))
    assert chunk.actions.dtype == np.float32
    np.testing.assert_array_equal(chunk.actions, actions)


def test_a_reply_may_be_the_bare_array_or_a_single_action() -> None:
    server = plain_server()
    server.answer = lambda request: some_actions(0, 0)[0]
    with remote(server, **{**PLAIN, "chunk_size": 1}) as policy:
        policy.reset(starts(7))
        assert policy.act(window(0)).actions.shape == (1, 7)


def test_a_server_of_roboarena_gets_its_endpoint_and_answers_resets_with_text() -> None:
    server = plain_server(needs_session_id=True)
    actions = {"actions": some_actions(0, 0)}
    server.answer = lambda one: "reset successful" if one["endpoint"] == "reset" else actions
    with remote(server, **PLAIN) as policy:
        run(policy, 7)
    assert sorted(server.requests[0]) == ["endpoint", "prompt", "session_id"]
    assert sorted(server.requests[1]) == ["endpoint", "observation/state", "prompt", "session_id"]


# ----------------------------------------------------------------------------------- refused at the start


@pytest.mark.parametrize(
    ("says", "problem"),
    [
        ({"action_dims": ["x", "y"]}, "names of the actions"),
        ({"control_mode": "pd_joint_delta_pos"}, "control mode"),
        ({"control_hz": 15.0}, "15 Hz"),
        ({"cameras": {"wrist": {"key": "i", "height_px": 1, "width_px": 1}}}, "no camera 'wrist'"),
        ({"cameras": {"base_camera": {"key": "i", "height_px": 9, "width_px": 9}}}, "resize to pad or plain"),
        ({"state_layouts": {"joints": ["x"]}}, "layout 'joints' has 1 numbers"),
        ({"state_layouts": {"odd": ["x"]}}, "no state layout 'odd'"),
        ({"chunk_size": None}, "how many actions a reply has"),
    ],
)
def test_a_server_that_does_not_fit_is_refused_before_the_first_episode(
    says: dict[str, Any], problem: str
) -> None:
    assert problem in refusal(SmallServer(**says))


@pytest.mark.parametrize("missing", ["cameras", "state", "chunk_size"])
def test_what_a_plain_server_does_not_say_must_be_in_the_recipe(missing: str) -> None:
    args = {key: value for key, value in PLAIN.items() if key != missing}
    assert f"args.{missing}" in refusal(plain_server(), **args)


def test_recipe_and_server_may_not_contradict_each_other() -> None:
    assert "chunk_size is 9 in the recipe" in refusal(SmallServer(), chunk_size=9)
    says = {"base_camera": {"key": "observation/image", "height_px": 128, "width_px": 128}}
    wrong = {"base_camera": {"key": "observation/pixels"}}
    assert "sends no observation/image" in refusal(SmallServer(cameras=says), cameras=wrong)


def test_a_server_that_takes_no_single_frames_is_asked_at_every_step() -> None:
    args = {**PLAIN, "reads": "every"}
    assert "--n-action-steps 1" in refusal(plain_server(), n_action_steps=4, **args)
    with remote(plain_server(), n_action_steps=1, **args) as policy:
        run(policy, 7)


def test_other_weights_than_planned_are_refused() -> None:
    planned = digest_of(ServerMetadata.from_wire(SmallServer().metadata, where="").identity())
    with remote(SmallServer(), identity_sha256=planned):
        pass
    with (
        pytest.raises(RemoteChangedError, match="other weights"),
        remote(SmallServer(weights_sha256="00" * 32), identity_sha256=planned),
    ):
        pass


def test_a_mistyped_argument_is_refused_by_name() -> None:
    with pytest.raises(RecipeError, match="Did you mean 'chunk_size'"), remote(SmallServer(), chunk_sise=3):
        pass


def test_a_named_key_that_is_not_set_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SOME_KEY", raising=False)
    assert "SOME_KEY is not set" in refusal(SmallServer(), api_key_env="SOME_KEY")


# ------------------------------------------------------------------------------------------ faults


def answering(reply: Any) -> SmallServer:
    server = SmallServer()
    usual = server.usual_answer
    server.answer = lambda one: reply(one) if one["endpoint"] == "infer" else usual(one)
    return server


def echo(request: dict[str, Any], **fields: Any) -> dict[str, Any]:
    return {
        "session_id": request["session_id"],
        "step": request["step"],
        "actions": some_actions(0, 0),
        **fields,
    }


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"session_id": "another"}, "expected the session"),
        ({"step": 5}, "expected the answer for step 0, found 5"),
        ({"step": None}, "found None"),
    ],
)
def test_an_answer_for_somebody_else_is_refused(change: dict[str, Any], problem: str) -> None:
    with remote(answering(lambda one: echo(one, **change))) as policy:
        with pytest.raises(RemoteReplyError, match=problem):
            run(policy, 7)
        with pytest.raises(RemoteConnectionError):  # nothing is used after that
            policy.act(window(0))


def test_an_answer_without_actions_is_refused() -> None:
    with (
        remote(
            answering(lambda one: {"session_id": one["session_id"], "step": 0, "message": "no"})
        ) as policy,
        pytest.raises(RemoteReplyError, match="no"),
    ):
        run(policy, 7)


@pytest.mark.parametrize(
    "actions",
    [
        np.zeros((CHUNK_SIZE, 6), dtype=np.float32),
        np.zeros((CHUNK_SIZE + 1, 7), dtype=np.float32),
        np.zeros((CHUNK_SIZE, 7), dtype=np.int64),
        np.full((CHUNK_SIZE, 7), np.nan, dtype=np.float32),
        np.full((CHUNK_SIZE, 7), 1e300),
        np.array(["a"]),
        "actions",
        [[1, 2], [3]],
        None,
        5,
        {},
    ],
)
def test_actions_of_another_shape_or_type_are_refused_as_of_any_policy(actions: Any) -> None:
    with (
        remote(answering(lambda one: echo(one, actions=actions))) as policy,
        pytest.raises(InvalidActionError, match="expected an ActionChunk"),
    ):
        run(policy, 7)


def test_conversion_leaves_what_is_not_sound_for_the_loop_to_refuse() -> None:
    wrong = np.full((CHUNK_SIZE, 7), np.nan, dtype=np.float32)
    with (
        remote(
            answering(lambda one: echo(one, actions=wrong)), actions={"gripper": "close_positive"}
        ) as policy,
        pytest.raises(InvalidActionError, match="nan"),
    ):
        run(policy, 7)


def test_a_worker_takes_the_server_with_the_fewest_sessions_and_leaves_the_others() -> None:
    busy, idle = SmallServer(n_sessions=5), SmallServer(n_sessions=1)
    context = PolicyContext(
        name="remote", env=make_env().spec, chunking=ChunkingSettings().at(1), n_candidates=3
    )
    with serving(busy) as first, serving(idle) as second:
        policy = make_remote(context, url=f"{first},{second}")
        run(policy, 7)
        policy.close()
    assert (len(busy.requests), len(idle.requests)) == (0, 9)  # a reset, and eight steps
