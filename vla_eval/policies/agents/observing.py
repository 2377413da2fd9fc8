"""What an agent is given of an observation, as arrays: a row for each mode.

`state` holds the answer; `vector` holds what is in view, and nothing that has to be remembered. Both are
numbers of the simulator, which no robot has: they are cheap, and for diagnosis.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any  # spaces of Gymnasium

import gymnasium as gym
import numpy as np

from vla_eval.base_tasks.named import DISCRETE, leaves_of, spaces_of
from vla_eval.config.agents import Observed
from vla_eval.core import FloatArray, Observation
from vla_eval.errors import RecipeError, SpecMismatchError, check_names
from vla_eval.specs import ActionSpec, EnvSpec
from vla_eval.task_state import PHASES, PrivilegedState
from vla_eval.tasks.catalog import task_spec

VECTOR, IMAGE, PLACES = "vector", "image", "places"
"""Names of what an agent is given; `places` (n, 3): of candidates, in m from the tool centre point."""
SMALLEST_IMAGE_PX = 36  # what the library's network of convolutions can read

Seen = Mapping[str, np.ndarray[Any, Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Mode:
    """How one mode reads an observation of a robot task."""

    read: Callable[[Observation], list[FloatArray]]
    places: Callable[[Observation], FloatArray] | None = None
    privileged: bool = False
    cameras: bool = False
    needs_candidates: bool = False


def _proprioception(seen: Observation) -> list[FloatArray]:
    return [seen.state[name] for name in sorted(seen.state)]


def _world(seen: Observation) -> PrivilegedState:
    world = seen.privileged
    assert isinstance(world, PrivilegedState)  # asked for by the spec
    return world


def _state(seen: Observation) -> list[FloatArray]:
    """Everything: arm, phase, where all things are, which are right, which were touched, where to go next."""
    world, tcp_m = _world(seen), _world(seen).tcp_position_m
    n = len(world.candidate_positions_m)
    order = np.zeros(n)
    for place, candidate in enumerate(world.right_candidates):
        order[candidate] = 1 - place / len(world.right_candidates)
    left = [one for one in world.right_candidates if one not in world.touched_candidates]
    parts = [
        *_proprioception(seen),
        world.tcp_velocity_m_s,
        [world.gripper_width_m, world.tcp_yaw_rad],
        _one_hot([PHASES.index(world.phase)], len(PHASES)),
        (world.candidate_positions_m - tcp_m).ravel(),
        order,
        _one_hot(world.shown_candidates, n),
        _one_hot(world.touched_candidates, n),
        (world.candidate_positions_m[left[0]] - tcp_m) if left else np.zeros(3 if n else 0),
        np.array([float(not left)] if n else []),
    ]
    for name in sorted(world.bodies):
        body = world.bodies[name]
        parts += [body.position_m - tcp_m, body.velocity_m_s, [body.yaw_rad]]
    return [np.asarray(part, np.float32) for part in parts]


def _vector(seen: Observation) -> list[FloatArray]:
    """Arm, which cue is shown now, and whether candidates are in view."""
    world = _world(seen)
    shown = _one_hot(world.shown_candidates, len(world.candidate_positions_m))
    parts = [*_proprioception(seen), shown, [float(_is_due(world))]]
    return [np.asarray(part, np.float32) for part in parts]


def _is_due(world: PrivilegedState) -> bool:
    return world.phase == "response"


def _places(seen: Observation) -> FloatArray:
    """Where each candidate lies from the response phase on; zeros before."""
    world = _world(seen)
    relative_m = world.candidate_positions_m - world.tcp_position_m
    return np.asarray(relative_m if _is_due(world) else np.zeros_like(relative_m), np.float32)


MODES: Mapping[Observed, _Mode] = {
    "state": _Mode(read=_state, privileged=True),
    "vector": _Mode(read=_vector, places=_places, privileged=True, needs_candidates=True),
    "rgb_joints": _Mode(read=_proprioception, cameras=True),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """What an agent is given on one task; `privileged`: it includes true states of the simulator."""

    mode: Observed
    cameras: tuple[str, ...]
    states: tuple[str, ...]
    privileged: bool
    read: Callable[[Observation], Seen]


def reader_of(env: EnvSpec, mode: Observed | None, *, n_candidates: int) -> Reader:
    """Return what reads observations of a task; None: `state`, or what a task of MIKASA-Base has.

    Raises:
        RecipeError: the task has no such observation.
    """
    if task_spec(env.task).is_base:
        return _base_reader(env, mode)
    check_names("observation", [mode or "state"], MODES, where=env.task)
    chosen: Observed = mode or "state"
    row = MODES[chosen]
    if row.needs_candidates and not n_candidates:
        raise RecipeError(
            f"--observation {chosen}: {env.task} has no candidates, so that it is not known what of it is in "
            "view. Use state, which has all of it, or rgb_joints."
        )
    cameras = tuple(camera.name for camera in env.cameras) if row.cameras else ()

    def read(seen: Observation) -> Seen:
        if row.privileged and seen.privileged is None:
            raise SpecMismatchError(f"{env.task}: the agent is given '{chosen}', and this has no true state.")
        found = {VECTOR: np.concatenate(row.read(seen))}
        if row.places is not None:
            found[PLACES] = row.places(seen)
        if cameras:
            found[IMAGE] = np.concatenate([seen.images[name].transpose(2, 0, 1) for name in cameras])
        return found

    return Reader(
        mode=chosen,
        cameras=cameras,
        states=tuple(state.name for state in env.states),
        privileged=row.privileged,
        read=read,
    )


def _base_reader(env: EnvSpec, mode: Observed | None) -> Reader:
    space, _ = spaces_of(env.task)
    large = tuple(
        camera.name for camera in env.cameras if min(camera.height_px, camera.width_px) >= SMALLEST_IMAGE_PX
    )
    offered: Observed = "image" if large else "vector"
    if mode not in (None, offered):
        raise RecipeError(f"--observation {mode}: {env.task} has '{offered}' alone. Leave it out.")

    def read(seen: Observation) -> Seen:
        vectors = [_as_numbers(leaf, seen, name) for name, leaf in leaves_of(space) if name not in large]
        found: dict[str, np.ndarray[Any, Any]] = {}
        if vectors:
            found[VECTOR] = np.concatenate(vectors)
        if large:
            found[IMAGE] = np.concatenate([seen.images[name].transpose(2, 0, 1) for name in large])
        return found

    return Reader(
        mode=offered,
        cameras=tuple(camera.name for camera in env.cameras),
        states=tuple(state.name for state in env.states),
        privileged=False,
        read=read,
    )


def _as_numbers(space: gym.Space[Any], seen: Observation, name: str) -> FloatArray:
    """Return a part of an observation as a vector, a number per value where it is one of several."""
    if name in seen.images:
        return seen.images[name].astype(np.float32).ravel()  # a few cells with numbers of things
    values = seen.state[name]
    if isinstance(space, gym.spaces.Discrete):
        return _one_hot([int(values[0]) - int(space.start)], int(space.n))
    if isinstance(space, gym.spaces.MultiDiscrete):
        counts, starts = space.nvec.ravel(), space.start.ravel()
        parts = zip(values, starts, counts, strict=True)
        hots: FloatArray = np.concatenate([_one_hot([int(v) - s], int(n)) for v, s, n in parts])
        return hots
    return values


def _one_hot(chosen: Any, n: int) -> FloatArray:  # Any: indices
    hot = np.zeros(n, np.float32)
    hot[list(chosen)] = 1
    return hot


def space_of(example: Seen) -> gym.spaces.Dict:
    """Return the space of what an agent is given, from an example."""
    return given_space({name: values.shape for name, values in example.items()})


def given_space(shapes: Mapping[str, tuple[int, ...]]) -> gym.spaces.Dict:
    """Return the space of vectors and images of these shapes."""
    spaces: dict[str, gym.Space[Any]] = {}
    for name, shape in shapes.items():
        is_image = name == IMAGE
        spaces[name] = (
            gym.spaces.Box(0, 255, shape, np.uint8)
            if is_image
            else gym.spaces.Box(-np.inf, np.inf, shape, np.float32)
        )
    return gym.spaces.Dict(spaces)


def action_space(action: ActionSpec) -> gym.Space[Any]:
    """Return the space of an agent's actions."""
    low, high = np.array(action.low, np.float32), np.array(action.high, np.float32)
    if action.control_mode != DISCRETE:
        return gym.spaces.Box(low, high, dtype=np.float32)
    counts = (high - low).astype(np.int64) + 1
    return gym.spaces.Discrete(int(counts[0])) if len(counts) == 1 else gym.spaces.MultiDiscrete(counts)


def as_action(action: ActionSpec, chosen: Any) -> FloatArray:  # Any: a number or an array
    """Return (A,) float32 of what an agent chose in `action_space`."""
    values: FloatArray = np.asarray(chosen, np.float32).reshape(-1)
    if action.control_mode == DISCRETE:
        values = values + np.array(action.low, np.float32)
    return values
