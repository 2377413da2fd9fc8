"""What a served policy reads and what it returns, as plain values: a server's first message says it.

Knows nothing of sockets, and imports nothing of `vla_eval`, which cannot be installed everywhere.
"""

from __future__ import annotations

import hashlib
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Mapping

import numpy as np

from mikasa_vla_client.numbers import (
    CHUNKING_MODES,
    COMMITTED_ACTIONS_KEY,
    COMMITTED_FROZEN_KEY,
    MEMORY,
    NumbersError,
    as_state,
    memory_problem,
)

__version__ = "0.1.0"
PROTOCOL = "openpi+1"

CAMERA_KEYS = {"base_camera": "observation/image", "hand_camera": "observation/wrist_image"}
"""Camera of the simulator -> key in an observation, as in openpi's policy for LIBERO."""

STATE_KEY, PROMPT_KEY = "observation/state", "prompt"
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_JOINTS = ("joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "joint7", "finger1", "finger2")
STATE_LAYOUTS = {
    "joints": (*_POSE, *_JOINTS, *(name + "_velocity" for name in _JOINTS)),
    "eef": ("x", "y", "z", "r11", "r21", "r31", "r12", "r22", "r32", "gripper_width"),
}
"""Layout -> the names of its numbers: what the simulator can give of the arm."""

ACTION_DIMS = ("dx", "dy", "dz", "drx", "dry", "drz", "gripper")
MAX_CHUNK_SIZE = 10_000  # many times the longest episode
_HASH_BLOCK_BYTES = 1 << 20


class SpecError(ValueError):
    """A `PolicySpec` has a value that is not allowed."""


@dataclass(frozen=True)
class PolicySpec:
    """What a policy reads and what it returns.

    Attributes:
        name: the policy's name in records and tables.
        chunk_size: how many actions one inference gives.
        n_action_steps: how many of them are executed before the next inference, unless the evaluation says.
        cameras: which cameras it needs: `base_camera`, `hand_camera`, both or none.
        state: what it reads of the arm: `joints` (25 numbers: pose, joint positions, joint velocities), `eef`
            (10: position, rotation columns, gripper width), or None.
        image_size_px: (height, width) of the images it takes.
        action_dims: the names of an action's numbers.
        control_mode: ManiSkill's name of the controller that the actions are for.
        control_hz: control steps per second.
        needs_every_frame: whether it must see each control step (a policy with a memory over frames); then it
            has a method `observe(session, observation)`.
        weights_file: the file of its weights, whose sha256 becomes part of a run's description; None for a
            policy without weights.
        has_memory: whether its memory of an episode can be read and replaced; then it has the methods
            `get_memory(session)`, which returns a dict of arrays, and `set_memory(session, memory)`.
        chunking_mode: `rtc` or `prefix` if a new chunk joins the one under way, else None. Observations then
            have `committed/actions` (N, number of action_dims) float32, the actions that are left of that
            chunk from this step on, and `committed/n_frozen`, how many of them will be executed before the
            new chunk can arrive; neither of the two where nothing is committed.
    """

    name: str
    chunk_size: int
    n_action_steps: int = 1
    cameras: tuple[str, ...] = ()
    state: str | None = None
    image_size_px: tuple[int, int] = (128, 128)
    action_dims: tuple[str, ...] = ACTION_DIMS
    control_mode: str = "pd_ee_delta_pose"
    control_hz: float = 20.0
    needs_every_frame: bool = False
    weights_file: str | None = None
    has_memory: bool = False
    chunking_mode: str | None = None

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            SpecError: one is not allowed.
        """
        self._expect(isinstance(self.name, str) and bool(self.name), "name", "a text that is not empty")
        for field in ("cameras", "action_dims"):  # a list is as good; a text would become its letters
            names = getattr(self, field)
            is_names = isinstance(names, (list, tuple)) and all(isinstance(name, str) for name in names)
            self._expect(is_names, field, "a tuple of names")
            object.__setattr__(self, field, tuple(names))
        self._expect(
            _is_count(self.chunk_size, MAX_CHUNK_SIZE), "chunk_size", f"a number from 1 to {MAX_CHUNK_SIZE}"
        )
        is_number = _is_count(self.n_action_steps, self.chunk_size)
        self._expect(is_number, "n_action_steps", "a number from 1 to chunk_size")
        known = ", ".join(CAMERA_KEYS)
        self._expect(set(self.cameras) <= set(CAMERA_KEYS), "cameras", "names out of " + known)
        layouts = " or ".join(repr(name) for name in STATE_LAYOUTS)
        self._expect(self.state is None or self.state in STATE_LAYOUTS, "state", layouts + " or None")
        is_size = isinstance(self.image_size_px, (list, tuple)) and len(self.image_size_px) == 2
        is_size = is_size and all(_is_count(side, 4096) for side in self.image_size_px)
        self._expect(is_size, "image_size_px", "(height, width), each from 1 to 4096")
        self._expect(len(self.action_dims) > 0, "action_dims", "at least one name")
        is_mode = isinstance(self.control_mode, str) and bool(self.control_mode)
        self._expect(is_mode, "control_mode", "a text that is not empty")
        is_rate = isinstance(self.control_hz, (int, float)) and 0 < self.control_hz < float("inf")
        self._expect(is_rate, "control_hz", "a number above 0")
        for field in ("needs_every_frame", "has_memory"):
            self._expect(isinstance(getattr(self, field), bool), field, "True or False")
        is_known = self.chunking_mode is None or self.chunking_mode in CHUNKING_MODES
        self._expect(is_known, "chunking_mode", " or ".join(map(repr, CHUNKING_MODES)) + " or None")
        is_there = self.weights_file is None or Path(self.weights_file).is_file()
        self._expect(is_there, "weights_file", "a file that exists, or None")

    def _expect(self, holds: bool, field: str, expected: str) -> None:
        if not holds:
            raise SpecError(f"PolicySpec: {field} is {getattr(self, field)!r}, expected {expected}.")

    def metadata(self) -> dict[str, Any]:
        """Return the server's first message; reads the whole weights file for its digest."""
        height_px, width_px = self.image_size_px
        dims = None if self.state is None else list(STATE_LAYOUTS[self.state])
        return {
            "protocol": PROTOCOL,
            "name": self.name,
            "weights_sha256": None if self.weights_file is None else _sha256(Path(self.weights_file)),
            "recipe_sha256": None,
            "chunk_size": self.chunk_size,
            "n_action_steps": self.n_action_steps,
            "control_mode": self.control_mode,
            "action_dims": list(self.action_dims),
            "control_hz": float(self.control_hz),
            "cameras": {
                name: {"key": CAMERA_KEYS[name], "height_px": height_px, "width_px": width_px}
                for name in self.cameras
            },
            "state_key": STATE_KEY,
            "state_dims": dims,
            "state_layouts": {} if self.state is None else {self.state: dims},
            "prompt_key": PROMPT_KEY,
            "needs_every_frame": self.needs_every_frame,
            "needs_session_id": False,
            "batch_max": 1,
            **({} if self.chunking_mode is None else {"chunking_mode": self.chunking_mode}),
            "supports": ["reset", "observe", "seed", *([MEMORY] if self.has_memory else [])],
            "versions": {
                "mikasa_vla_client": __version__,
                "numpy": np.__version__,
                "python": platform.python_version(),
            },
        }

    def check_observation(self, observation: Mapping[str, Any]) -> None:
        """Refuse an observation that is not what the policy reads.

        Args:
            observation: key -> (H, W, 3) uint8 image, or the state as float numbers.

        Raises:
            ValueError: a key is not there, or its value has another shape or type; a state is not finite, or
                its rotation is none.
        """
        for camera in self.cameras:
            expected = (*self.image_size_px, 3)
            _check_image(observation, CAMERA_KEYS[camera], expected)
        if self.state is not None:
            try:
                as_state(_required(observation, STATE_KEY), STATE_LAYOUTS[self.state])
            except NumbersError as exc:
                raise ValueError(f"'{STATE_KEY}': {exc}.") from exc
        self._check_committed(observation)

    def _check_committed(self, observation: Mapping[str, Any]) -> None:
        says = [key for key in (COMMITTED_ACTIONS_KEY, COMMITTED_FROZEN_KEY) if key in observation]
        if not says:
            return
        if self.chunking_mode is None:
            raise ValueError(
                f"'{says[0]}': the chunks of policy '{self.name}' do not join what is committed "
                "(`chunking_mode` is None)."
            )
        actions = _required(observation, COMMITTED_ACTIONS_KEY)
        n_frozen = _required(observation, COMMITTED_FROZEN_KEY)
        n_dims = len(self.action_dims)
        is_array = isinstance(actions, np.ndarray) and actions.dtype == np.float32 and actions.ndim == 2
        fits = is_array and actions.shape[1] == n_dims and len(actions) <= self.chunk_size
        if not fits or not np.isfinite(actions).all():
            found = f"{actions.dtype} of shape {actions.shape}" if is_array else type(actions).__name__
            raise ValueError(
                f"'{COMMITTED_ACTIONS_KEY}': expected float32 of shape (N, {n_dims}), all finite, with N at "
                f"most {self.chunk_size}, found {found}."
            )
        is_number = isinstance(n_frozen, int) and not isinstance(n_frozen, bool)
        if not is_number or not 0 <= n_frozen <= len(actions):
            raise ValueError(
                f"'{COMMITTED_FROZEN_KEY}': expected a number from 0 to {len(actions)}, the rows of "
                f"'{COMMITTED_ACTIONS_KEY}', found {n_frozen!r:.80}."
            )

    def check_memory(self, memory: Any) -> dict[str, Any]:
        """Return a memory that the policy has handed out, or that it is to get.

        Raises:
            ValueError: it is no map of arrays of numbers, or too large for a message.
        """
        problem = memory_problem(memory)
        if problem is not None:
            raise ValueError(f"the memory of policy '{self.name}': {problem}.")
        return dict(memory)

    def check_actions(self, actions: Any) -> np.ndarray[Any, Any]:
        """Return a policy's answer as a float32 array of its own.

        Raises:
            ValueError: it has another shape or type, or values that are not finite.
        """
        given = np.array(actions)
        if given.dtype.kind not in "fiu":
            raise ValueError(
                f"policy '{self.name}' returned actions of dtype {given.dtype}, expected real numbers."
            )
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused
            array = given.astype(np.float32)
        expected = (self.chunk_size, len(self.action_dims))
        if array.shape != expected:
            raise ValueError(
                f"policy '{self.name}' returned actions of shape {array.shape}, expected {expected}: "
                f"(chunk_size, number of action_dims)."
            )
        if not np.isfinite(array).all():
            raise ValueError(f"policy '{self.name}' returned actions that are not finite.")
        return array


def _is_count(value: Any, maximum: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= maximum


def _required(observation: Mapping[str, Any], key: str) -> Any:
    if key not in observation:
        found = ", ".join(sorted(observation)) or "nothing"
        raise ValueError(f"the observation has no '{key}' (it has: {found}).")
    return observation[key]


def _check_image(observation: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> None:
    value = _required(observation, key)
    is_array = isinstance(value, np.ndarray)
    if not is_array or value.shape != shape or value.dtype != np.uint8:
        found = f"{value.dtype} of shape {value.shape}" if is_array else type(value).__name__
        raise ValueError(f"'{key}': expected uint8 of shape {shape}, found {found}.")


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for block in iter(lambda: file.read(_HASH_BLOCK_BYTES), b""):
            digest.update(block)
    return digest.hexdigest()
