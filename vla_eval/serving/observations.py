"""From a request to an observation; what does not fit is refused, and nothing is resized or filled in."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any  # Any: what a client sends

import numpy as np

from vla_eval.control_modes import MOTORS
from vla_eval.core import CommittedActions, FloatArray, ImageArray, Observation
from vla_eval.errors import SpecMismatchError, VlaEvalError, did_you_mean, some_of
from vla_eval.features import PROPRIO_STATES, STATE_NAMES
from vla_eval.specs import EnvSpec, PolicySpec
from vla_eval.strict.json_text import shown
from vla_eval.wire.metadata import CameraImage
from vla_eval.wire.numbers import (
    COMMITTED_ACTIONS_KEY,
    COMMITTED_FROZEN_KEY,
    FLOAT_TYPES,
    NumbersError,
    as_state,
)

CAMERA_WIRE_KEYS = {"base_camera": "observation/image", "hand_camera": "observation/wrist_image"}
"""Camera -> key of its image. Source: openpi's policy for LIBERO,
https://github.com/Physical-Intelligence/openpi/blob/15a9616a00943ada6c20a0f158e3adb39df2ccac/src/openpi/policies/libero_policy.py"""
IMAGE_WIRE_PREFIX = "observation/images/"
"""Beginning of the key of another camera's image."""
STATE_WIRE_KEY = "observation/state"
PROMPT_WIRE_KEY = "prompt"


class RequestError(VlaEvalError):
    """A client sent something that the server cannot answer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationReader:
    """Reads the observations that a policy needs."""

    cameras: Mapping[str, CameraImage]  # camera of the policy -> key and size of its image
    # the policy's states -> names of their numbers, in the order in which a request holds them
    states: Mapping[str, tuple[str, ...]]
    # whether a state may also be the 10 numbers of the kind `eef`, which the policy reads
    end_effector: bool
    # of a policy whose chunks join: rows and numbers of a chunk; None: it gets nothing of it
    chunk_shape: tuple[int, int] | None = None

    @property
    def state_layouts(self) -> dict[str, tuple[str, ...]]:
        """Name of a layout -> names of its numbers; empty if the policy reads no state."""
        if not self.states:
            return {}
        if tuple(self.states) == PROPRIO_STATES:
            layouts = {"joints": STATE_NAMES["joints"]}
        else:
            joined = tuple(name for dims in self.states.values() for name in dims)
            layouts = {"+".join(self.states): joined}
        if self.end_effector:
            layouts["eef"] = STATE_NAMES["eef"]
        return layouts

    def read(self, request: Mapping[str, Any], *, step: int) -> Observation:
        """Return a request's observation after `step` control steps; a `RequestError` if it does not fit."""
        return Observation(
            step=step,
            images={name: _read_image(request, camera) for name, camera in self.cameras.items()},
            state=self._read_state(request) if self.states else {},
        )

    def read_committed(self, request: Mapping[str, Any]) -> CommittedActions | None:
        """Return what is committed when a request is made; None if the policy gets nothing of it.

        A request that says nothing of it is one at which nothing is.
        """
        says = any(request.get(key) is not None for key in (COMMITTED_ACTIONS_KEY, COMMITTED_FROZEN_KEY))
        if self.chunk_shape is None:
            if not says:
                return None
            raise RequestError(
                f"'{COMMITTED_ACTIONS_KEY}': the policy's chunks do not join what is committed. Start the "
                "server with --chunking-mode, or leave it out."
            )
        if not says:
            return CommittedActions(actions=np.zeros((0, self.chunk_shape[1]), dtype=np.float32), n_frozen=0)
        return _read_committed(request, self.chunk_shape)

    def _read_state(self, request: Mapping[str, Any]) -> dict[str, FloatArray]:
        layouts = {len(names): (kind, names) for kind, names in self.state_layouts.items()}
        expected = " or ".join(f"{size} numbers ({kind})" for size, (kind, _) in layouts.items())
        vector = _required(request, STATE_WIRE_KEY, expected)
        is_vector = isinstance(vector, np.ndarray) and vector.ndim == 1
        if not is_vector or vector.dtype.name not in FLOAT_TYPES:
            raise RequestError(
                f"'{STATE_WIRE_KEY}': expected an array of {expected}, float32; found {_described(vector)}."
            )
        if len(vector) not in layouts:
            raise RequestError(f"'{STATE_WIRE_KEY}': expected {expected}, found {len(vector)} numbers.")
        kind, names = layouts[len(vector)]
        try:
            values = as_state(vector, names)
        except NumbersError as exc:
            raise RequestError(f"'{STATE_WIRE_KEY}': {exc}.") from exc
        if self.end_effector and kind == "eef":
            return {"eef": values}
        ends = np.cumsum([len(dims) for dims in self.states.values()])[:-1]
        return {name: part.copy() for name, part in zip(self.states, np.split(values, ends), strict=True)}


def observation_reader(policy: PolicySpec, env: EnvSpec, *, end_effector: bool) -> ObservationReader:
    """Return what reads the observations of a policy; `end_effector`: it also reads the kind `eef`."""
    sizes = {camera.name: (camera.height_px, camera.width_px) for camera in env.cameras}
    keys = CAMERA_WIRE_KEYS
    if env.action.control_mode == MOTORS:  # of an arm, whose cameras have names of their own
        keys = {
            camera.name: keys.get(camera.name, f"{IMAGE_WIRE_PREFIX}{camera.name}") for camera in env.cameras
        }
    for camera in policy.cameras:
        if camera not in keys:
            raise SpecMismatchError(
                f"policy '{policy.name}' needs the camera '{camera}', which cannot be sent to a server "
                f"(it takes: {', '.join(keys)}).{did_you_mean(camera, keys)}"
            )
    dims = {state.name: state.dims for state in env.states}
    return ObservationReader(
        cameras={name: CameraImage(keys[name], *sizes[name]) for name in policy.cameras},
        states={name: dims[name] for name in policy.states},
        end_effector=end_effector,
        chunk_shape=(policy.chunk_size, len(env.action.dims)) if policy.reads_committed else None,
    )


def read_prompt(request: Mapping[str, Any]) -> str:
    """Return the instruction of a request; a `RequestError` if there is none."""
    prompt = _required(request, PROMPT_WIRE_KEY, "the instruction, text")
    if not isinstance(prompt, str) or not prompt.strip():
        raise RequestError(f"'{PROMPT_WIRE_KEY}': expected the instruction, found {shown(prompt)}.")
    return prompt


def _read_image(request: Mapping[str, Any], camera: CameraImage) -> ImageArray:
    expected = f"an image ({camera.height_px}, {camera.width_px}, 3), uint8"
    image = _required(request, camera.key, expected)
    shape = (camera.height_px, camera.width_px, 3)
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != shape:
        raise RequestError(f"'{camera.key}': expected {expected}; found {_described(image)}.")
    return image


def _read_committed(request: Mapping[str, Any], chunk_shape: tuple[int, int]) -> CommittedActions:
    n_rows, n_dims = chunk_shape
    expected = f"an array (N, {n_dims}), float32, all finite, of at most {n_rows} rows"
    actions = _required(request, COMMITTED_ACTIONS_KEY, expected)
    is_array = isinstance(actions, np.ndarray) and actions.dtype == np.float32 and actions.ndim == 2
    fits = is_array and actions.shape[1] == n_dims and len(actions) <= n_rows
    if not fits or not np.isfinite(actions).all():
        raise RequestError(f"'{COMMITTED_ACTIONS_KEY}': expected {expected}; found {_described(actions)}.")
    numbers = f"a number from 0 to {len(actions)}, the rows of '{COMMITTED_ACTIONS_KEY}'"
    n_frozen = _required(request, COMMITTED_FROZEN_KEY, numbers)
    if not isinstance(n_frozen, int) or isinstance(n_frozen, bool) or not 0 <= n_frozen <= len(actions):
        raise RequestError(f"'{COMMITTED_FROZEN_KEY}': expected {numbers}; found {shown(n_frozen)}.")
    return CommittedActions(actions=actions.copy(), n_frozen=n_frozen)


def _required(request: Mapping[str, Any], key: str, expected: str) -> Any:
    if request.get(key) is None:
        names: Sequence[str] = sorted(request)
        raise RequestError(
            f"the request has no '{key}': expected {expected}; found {some_of(names) or 'no keys'}."
            f"{did_you_mean(key, names)}"
        )
    return request[key]


def _described(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"an array {value.shape}, {value.dtype}"
    return shown(value)
