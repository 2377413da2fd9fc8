"""Server metadata, a policy server's first message: what it does not say is unknown, not none."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple  # Any: a server may say anything

import numpy as np

from vla_eval.errors import RemoteReplyError
from vla_eval.seeding import SeedRange
from vla_eval.strict.bounds import MAX_SEED, MAX_SERVER_ROWS
from vla_eval.strict.json_text import shown

PROTOCOL = "openpi+1"
SUPPORTS = ("reset", "observe", "seed", "row")
NOT_COMPARED = ("n_sessions", "training_seeds", "sentences")

MAX_ACTIONS = 10_000  # of one reply
MAX_IMAGE_PX = 4096
MAX_COUNT = 2**31
MAX_NUMBERS_SHOWN = 64  # of an array among what a server says; of a larger one, the digest is recorded


class CameraImage(NamedTuple):
    """How a server wants the image of a camera: the key in a request, and its size, None if unknown."""

    key: str
    height_px: int | None
    width_px: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerMetadata:
    """What a server reports about itself and its policy. None: it does not say."""

    # `openpi+1` if it is a server of this wire; a field that is None then means: there is none
    protocol: str | None = None
    name: str | None = None
    weights_known: bool = False  # whether it says which weights the policy has
    # digest of the weights; None for a policy without weights, or if not known
    weights_sha256: str | None = None
    recipe_sha256: str | None = None
    chunk_size: int | None = None  # actions of one reply
    # actions executed per inference, where the evaluation names no number
    n_action_steps: int | None = None
    # `control_mode`, `action_dims`, `control_hz`: what the actions are for; `action_dims` are their
    # names
    control_mode: str | None = None
    action_dims: tuple[str, ...] | None = None
    control_hz: float | None = None
    cameras: Mapping[str, CameraImage] | None = None  # our name of a camera -> how its image is sent
    # `state_key`, `state_dims`: key and names of the proprioceptive vector
    state_key: str | None = None
    state_dims: tuple[str, ...] | None = None
    # name of a layout -> names of its numbers, for every layout that the server accepts
    state_layouts: Mapping[str, tuple[str, ...]] | None = None
    prompt_key: str | None = None  # key of the instruction
    needs_every_frame: bool | None = None  # whether the policy must see each control step
    needs_session_id: bool | None = None  # whether requests must name their session
    batch_max: int | None = None  # rows of a shared pass; see `EpisodeStart.row`
    # the mode (`chunking.mode`) in which its chunks join what a request says is committed; None: they do not
    chunking_mode: str | None = None
    supports: tuple[str, ...] = ()  # which of `reset`, `observe`, `seed`, `row` and `memory` may be sent
    versions: Mapping[str, str] | None = None  # package -> version, at the server
    n_sessions: int | None = None
    # task -> the seeds of the demonstrations that the policy was trained on
    training_seeds: Mapping[str, tuple[SeedRange, ...]] | None = None
    # task -> the sentences that the policy was trained with
    sentences: Mapping[str, tuple[str, ...]] | None = None
    other: Mapping[str, Any] = field(default_factory=dict)  # what else it says

    @property
    def is_ours(self) -> bool:
        """Whether it is a server of this wire, and not only one of openpi's."""
        return self.protocol == PROTOCOL

    @property
    def takes_sessions(self) -> bool:
        """Whether requests may hold `endpoint` and `session_id`, as RoboArena's servers demand."""
        return self.is_ours or self.needs_session_id is not None

    @property
    def takes_reset(self) -> bool:
        """Whether an episode begins with a request `reset`."""
        return "reset" in self.supports or (not self.is_ours and self.needs_session_id is not None)

    def to_wire(self) -> dict[str, Any]:
        """Return the first message of a server of this wire."""
        left_out = {"weights_known", "other"}
        unsaid = ("training_seeds", "sentences", "chunking_mode")
        left_out |= {name for name in unsaid if getattr(self, name) is None}
        if not self.weights_known:
            left_out.add("weights_sha256")
        names = [one.name for one in fields(self) if one.name not in left_out]
        return {**self.other, **{name: _on_wire(getattr(self, name)) for name in names}}

    def identity(self) -> dict[str, Any]:
        """Return what is compared when a run is resumed, as JSON can hold it.

        Left out are what the server does not say, the number of sessions, and seeds and sentences of the
        training, which the digest of the weights covers.
        """
        message = {key: value for key, value in self.to_wire().items() if key not in NOT_COMPARED}
        unsaid = () if self.is_ours else [key for key, value in message.items() if value is None]
        return {key: _as_json(value) for key, value in message.items() if key not in unsaid}

    @classmethod
    def from_wire(cls, message: object, *, where: str) -> "ServerMetadata":
        """Read the first message of a server; `where` is its address, for messages."""
        if not isinstance(message, Mapping):
            raise RemoteReplyError(
                f"{where}: expected a map as the first message (the server's metadata), found "
                f"{shown(message)}. Check that a policy server answers at this address."
            )
        read = {
            name: _read(message[name], name, reader, where=where)
            for name, reader in _READERS.items()
            if message.get(name) is not None
        }
        other = {key: value for key, value in message.items() if key not in _READERS}
        metadata = cls(**read, weights_known="weights_sha256" in message, other=other)
        if not metadata.is_ours and (metadata.protocol or "").startswith("openpi+"):
            raise RemoteReplyError(
                f"{where}: the server speaks '{metadata.protocol:.40}', this program '{PROTOCOL}'. Use the "
                f"same version of mikasa-vla-eval at both ends."
            )
        return metadata


def _on_wire(value: Any) -> Any:
    """Return a field as a message holds it."""
    if isinstance(value, CameraImage):
        return value._asdict()
    if isinstance(value, SeedRange):
        return [value.first, value.last]
    if isinstance(value, Mapping):
        return {name: _on_wire(item) for name, item in value.items()}
    return [_on_wire(item) for item in value] if isinstance(value, tuple) else value


def _read(value: object, name: str, reader: "_Reader", *, where: str) -> Any:
    read = reader.read(value)
    if read is None:
        raise RemoteReplyError(
            f"{where}: the server says '{name}': {shown(value)}; expected {reader.expected}. Correct what "
            f"the server reports."
        )
    return read


class _Reader(NamedTuple):
    expected: str
    read: Callable[[Any], Any]  # returns None for what does not fit


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) and value else None


def _flag(value: Any) -> bool | None:
    return bool(value) if isinstance(value, bool | np.bool_) else None


def _count(least: int, most: int) -> Callable[[Any], int | None]:
    def read(value: Any) -> int | None:
        is_number = isinstance(value, int | np.integer) and not isinstance(value, bool)
        return int(value) if is_number and least <= value <= most else None

    return read


def _rate(value: Any) -> float | None:
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return float(value) if is_number and 0 < value < float("inf") else None


def _names(value: Any) -> tuple[str, ...] | None:
    is_list = isinstance(value, list | tuple) and all(isinstance(item, str) for item in value)
    return tuple(value) if is_list else None


def _map_of(read_item: Callable[[Any], Any]) -> Callable[[Any], dict[str, Any] | None]:
    def read(value: Any) -> dict[str, Any] | None:
        items = (
            {name: read_item(item) for name, item in value.items()} if isinstance(value, Mapping) else None
        )
        return None if items is None or any(item is None for item in items.values()) else items

    return read


def _seeds(pairs: Any) -> tuple[SeedRange, ...] | None:
    if not isinstance(pairs, list | tuple) or not all(isinstance(pair, list | tuple) for pair in pairs):
        return None
    numbers = [[_count(0, MAX_SEED)(number) for number in pair] for pair in pairs]
    if any(len(pair) != 2 or None in pair for pair in numbers):
        return None
    return tuple(SeedRange(first=first or 0, last=last or 0) for first, last in numbers)


def _camera(value: Any) -> CameraImage | None:
    if not isinstance(value, Mapping) or _text(value.get("key")) is None:
        return None
    sizes = [value.get(name) for name in ("height_px", "width_px")]
    height_px, width_px = (None if size is None else _count(1, MAX_IMAGE_PX)(size) for size in sizes)
    if (height_px is None, width_px is None) != (sizes[0] is None, sizes[1] is None):
        return None
    return CameraImage(value["key"], height_px, width_px)


_READERS = {
    "protocol": _Reader("text", _text),
    "name": _Reader("text", _text),
    "weights_sha256": _Reader("text", _text),
    "recipe_sha256": _Reader("text", _text),
    "chunk_size": _Reader(f"a number from 1 to {MAX_ACTIONS}", _count(1, MAX_ACTIONS)),
    "n_action_steps": _Reader(f"a number from 1 to {MAX_ACTIONS}", _count(1, MAX_ACTIONS)),
    "control_mode": _Reader("text", _text),
    "action_dims": _Reader("a list of names", _names),
    "control_hz": _Reader("a number > 0", _rate),
    "cameras": _Reader("a map of cameras, each with 'key', 'height_px' and 'width_px'", _map_of(_camera)),
    "state_key": _Reader("text", _text),
    "state_dims": _Reader("a list of names", _names),
    "state_layouts": _Reader("a map of lists of names", _map_of(_names)),
    "prompt_key": _Reader("text", _text),
    "needs_every_frame": _Reader("true or false", _flag),
    "needs_session_id": _Reader("true or false", _flag),
    "batch_max": _Reader(f"a number from 1 to {MAX_SERVER_ROWS}", _count(1, MAX_SERVER_ROWS)),
    "chunking_mode": _Reader("text", _text),
    "supports": _Reader("a list of names", _names),
    "versions": _Reader("a map of texts", _map_of(lambda value: value if isinstance(value, str) else None)),
    "n_sessions": _Reader("a number ≥ 0", _count(0, MAX_COUNT)),
    "training_seeds": _Reader("a map of lists of first and last seeds", _map_of(_seeds)),
    "sentences": _Reader("a map of lists of texts", _map_of(_names)),
}


def _as_json(value: Any) -> Any:
    """Return a value as JSON can hold it; a large array as its digest."""
    if isinstance(value, Mapping):
        return {str(key): _as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(item) for item in value]
    if isinstance(value, np.generic):
        return _as_json(value.item())
    if isinstance(value, np.ndarray):
        if value.size <= MAX_NUMBERS_SHOWN:
            return _as_json(value.tolist())
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return {"shape": list(value.shape), "dtype": str(value.dtype), "sha256": digest}
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value
