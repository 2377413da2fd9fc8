"""What a server says of itself: read strictly, written as it was read, compared without what may change."""

import json
from typing import Any

import numpy as np
import pytest

from vla_eval.errors import RemoteReplyError
from vla_eval.seeding import SeedRange
from vla_eval.wire.codec import packb, unpackb
from vla_eval.wire.metadata import CameraImage, ServerMetadata

WHERE = "ws://here:8000"
OURS: dict[str, Any] = {
    "protocol": "openpi+1",
    "name": "memory_color3",
    "weights_sha256": "ab" * 32,
    "recipe_sha256": "cd" * 32,
    "chunk_size": 8,
    "n_action_steps": 4,
    "control_mode": "pd_ee_delta_pose",
    "action_dims": ["dx", "dy", "dz", "drx", "dry", "drz", "gripper"],
    "control_hz": 20.0,
    "cameras": {"base_camera": {"key": "observation/image", "height_px": 128, "width_px": 96}},
    "state_key": "observation/state",
    "state_dims": ["x", "y"],
    "state_layouts": {"joints": ["x", "y"], "eef": ["x"]},
    "prompt_key": "prompt",
    "needs_every_frame": True,
    "needs_session_id": True,
    "batch_max": 4,
    "supports": ["reset", "observe", "seed", "row"],
    "versions": {"numpy": "2.2.6"},
    "n_sessions": 3,
}


def read(message: object) -> ServerMetadata:
    return ServerMetadata.from_wire(message, where=WHERE)


def test_what_is_read_is_written_as_it_was() -> None:
    assert unpackb(packb(read(OURS).to_wire())) == OURS
    assert read(unpackb(packb(read(OURS).to_wire()))) == read(OURS)


def test_cameras_keep_height_and_width_apart() -> None:
    assert read(OURS).cameras == {"base_camera": CameraImage("observation/image", height_px=128, width_px=96)}


def test_the_number_of_sessions_is_no_part_of_the_identity() -> None:
    assert read(OURS).identity() == read({**OURS, "n_sessions": 0}).identity()
    assert read(OURS).identity() != read({**OURS, "weights_sha256": "ef" * 32}).identity()


def test_training_seeds_are_read_and_written_and_no_part_of_the_identity() -> None:
    seeds = {"RememberColor3-v0": [[1000, 1001], [1003, 1003]]}
    found = read({**OURS, "training_seeds": seeds})
    first, second = SeedRange(first=1000, last=1001), SeedRange(first=1003, last=1003)
    assert found.training_seeds == {"RememberColor3-v0": (first, second)}
    assert unpackb(packb(found.to_wire())) == {**OURS, "training_seeds": seeds}
    assert found.identity() == read(OURS).identity()  # earlier versions did not say them


def test_sentences_are_read_and_written_and_no_part_of_the_identity() -> None:
    sentences = {"RememberColor3-v0": ["lift it", "lift it, please"], "": ["touch it"]}
    found = read({**OURS, "sentences": sentences})
    assert found.sentences == {"RememberColor3-v0": ("lift it", "lift it, please"), "": ("touch it",)}
    assert unpackb(packb(found.to_wire())) == {**OURS, "sentences": sentences}
    assert found.identity() == read(OURS).identity()  # earlier versions did not say them


@pytest.mark.parametrize(
    "seeds", [[1], {"t": 1}, {"t": [1, 2]}, {"t": [[1]]}, {"t": [[1, "2"]]}, {"t": [[-1, 2]]}]
)
def test_training_seeds_of_another_form_are_refused(seeds: object) -> None:
    with pytest.raises(RemoteReplyError, match=r"'training_seeds': .* expected a map of lists of first and"):
        read({**OURS, "training_seeds": seeds})


def test_a_plain_server_says_nothing_and_may_be_sent_nothing() -> None:
    plain = read({})
    assert (plain.is_ours, plain.takes_sessions, plain.takes_reset, plain.weights_known) == (False,) * 4
    assert plain.identity() == {"supports": []}


def test_unknown_weights_are_not_the_same_as_no_weights() -> None:
    without = {key: value for key, value in OURS.items() if key != "weights_sha256"}
    assert not read(without).weights_known
    assert "weights_sha256" not in read(without).to_wire()
    scripted = read({**OURS, "weights_sha256": None})
    assert scripted.weights_known
    assert scripted.identity()["weights_sha256"] is None


def test_a_server_of_roboarena_gets_sessions_and_resets() -> None:
    arena = read({"needs_session_id": True, "image_resolution": (180, 320), "n_external_cameras": 1})
    assert (arena.takes_sessions, arena.takes_reset, arena.is_ours) == (True, True, False)


def test_what_else_a_server_says_is_part_of_its_identity() -> None:
    says = {"reset_pose": np.array([0.0, 1.5]), "config": "pi05_droid", "scale": float("nan"), "id": b"\x01"}
    identity = json.loads(json.dumps(read(says).identity(), allow_nan=False))
    assert identity["reset_pose"] == [0.0, 1.5]
    assert (identity["config"], identity["scale"], identity["id"]) == ("pi05_droid", "nan", "01")
    large = read({"mean": np.arange(1000.0)}).identity()["mean"]
    assert large["shape"] == [1000]
    assert large != read({"mean": np.arange(1000.0) + 1}).identity()["mean"]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("name", 3),
        ("name", ""),
        ("chunk_size", 0),
        ("chunk_size", True),
        ("chunk_size", "8"),
        ("control_hz", 0),
        ("control_hz", float("nan")),
        ("control_hz", float("inf")),
        ("action_dims", "dx"),
        ("action_dims", [1]),
        ("cameras", ["base_camera"]),
        ("cameras", {"base_camera": {"height_px": 1, "width_px": 1}}),
        ("cameras", {"base_camera": {"key": "observation/image", "height_px": -1, "width_px": 1}}),
        ("state_layouts", {"joints": [1]}),
        ("sentences", ["lift it"]),
        ("sentences", {"t": "lift it"}),
        ("sentences", {"t": [1]}),
        ("needs_every_frame", 1),
        ("batch_max", 0),
        ("batch_max", 10**9),
        ("supports", "reset"),
        ("versions", {"numpy": 2}),
        ("n_sessions", -1),
    ],
)
def test_a_field_of_another_type_is_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(RemoteReplyError, match=rf"{WHERE}: the server says '{field}'"):
        read({**OURS, field: value})


@pytest.mark.parametrize("message", [[], "text", None, np.zeros(3), 5])
def test_a_first_message_that_is_no_map_is_refused(message: object) -> None:
    with pytest.raises(RemoteReplyError, match="first message"):
        read(message)


def test_another_version_of_the_wire_is_refused() -> None:
    with pytest.raises(RemoteReplyError, match=r"speaks 'openpi\+2', this program 'openpi\+1'"):
        read({**OURS, "protocol": "openpi+2"})
