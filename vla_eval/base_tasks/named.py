"""Observations and actions of MIKASA-Base as named vectors and images, and back.

An action is one number per dimension; a whole one where the environment's space is discrete. Nothing is
rounded or clipped for a policy: an action outside of the space is an error.
"""

import functools
from typing import Any  # observations and spaces of Gymnasium

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.env import BaseTaskEnv
from vla_eval.base_tasks.make import make_base_task
from vla_eval.core import FloatArray, ImageArray, Observation
from vla_eval.errors import InvalidActionError
from vla_eval.specs import ActionSpec, CameraSpec, EnvSpec, StateSpec

OBSERVATION, IMAGE = "observation", "image"
"""What an observation is called that has no name of its own."""
DISCRETE, CONTINUOUS = "discrete", "continuous"
STEP_HZ = 1.0
"""Steps are not timed: a second is a step."""


@functools.cache
def spaces_of(task: str) -> tuple[gym.Space[Any], gym.Space[Any]]:
    """Return the observation space and the action space of a task."""
    env = make_base_task(task)
    env.close()
    return env.observation_space, env.action_space


def spec_of(task: str, env: BaseTaskEnv) -> EnvSpec:
    """Return what an environment offers, as its spaces say."""
    cameras: list[CameraSpec] = []
    states: list[StateSpec] = []
    for name, space in leaves_of(env.observation_space):
        if _is_image(space):
            height_px, width_px, _ = space.shape or ()
            cameras.append(CameraSpec(name=name, height_px=height_px, width_px=width_px, fov_rad=None))
        else:
            n_dims = int(np.prod(space.shape or (1,)))
            dims = tuple(f"{name}_{k}" for k in range(n_dims))
            states.append(StateSpec(name=name, dims=dims, unit="as the environment has it", frame="none"))
    return EnvSpec(
        task=task,
        cameras=tuple(cameras),
        states=tuple(states),
        action=_action_spec(env.action_space),
        horizon_steps=env.horizon_steps,
        control_hz=STEP_HZ,
        is_instructed=False,
    )


def _action_spec(space: gym.Space[Any]) -> ActionSpec:
    if isinstance(space, gym.spaces.Discrete):
        low, high, mode = [float(space.start)], [float(space.start + space.n - 1)], DISCRETE
    elif isinstance(space, gym.spaces.MultiDiscrete):
        low, high, mode = [0.0] * space.nvec.size, (space.nvec.ravel() - 1.0).tolist(), DISCRETE
    else:
        assert isinstance(space, gym.spaces.Box), space
        low, high, mode = space.low.ravel().tolist(), space.high.ravel().tolist(), CONTINUOUS
    return ActionSpec(
        dims=tuple(f"action_{k}" for k in range(len(low))),
        low=tuple(low),
        high=tuple(high),
        control_mode=mode,
        gripper_open=None,
    )


def native_action(space: gym.Space[Any], action: FloatArray, *, task: str) -> Any:
    """Return (A,) float32 as an action of the space.

    Raises:
        InvalidActionError: it is none: not whole, or out of bounds.
    """
    if isinstance(space, gym.spaces.Box):
        native: Any = np.asarray(action, dtype=space.dtype).reshape(space.shape)
        is_one = space.contains(native)
    else:
        whole = np.rint(action).astype(np.int64)
        native = int(whole[0]) if isinstance(space, gym.spaces.Discrete) else whole.reshape(space.shape or ())
        is_one = np.array_equal(whole, action) and space.contains(native)
    if not is_one:
        raise InvalidActionError(
            f"{task}: expected an action of {space}, found {action.tolist()}. Nothing is rounded or clipped."
        )
    return native


def as_named(observation: Any) -> tuple[dict[str, ImageArray], dict[str, FloatArray]]:
    """Return the images and the vectors of an observation, by their names."""
    leaves = observation if isinstance(observation, dict) else {None: observation}
    images: dict[str, ImageArray] = {}
    vectors: dict[str, FloatArray] = {}
    for key, leaf in leaves.items():
        values: NDArray[Any] = np.asarray(leaf)
        if values.ndim == 3 and values.dtype == np.uint8:
            images[IMAGE if key is None else key] = values
        else:
            vectors[OBSERVATION if key is None else key] = values.astype(np.float32).reshape(-1)
    return images, vectors


def as_native(space: gym.Space[Any], observation: Observation) -> Any:
    """Return an observation as the environment gave it: the inverse of `as_named`."""
    found: dict[str, Any] = {}
    for name, leaf in leaves_of(space):
        if _is_image(leaf):
            found[name] = observation.images[name]
        else:
            values = observation.state[name].astype(leaf.dtype).reshape(leaf.shape or ())
            found[name] = int(values) if isinstance(leaf, gym.spaces.Discrete) else values
    return found if isinstance(space, gym.spaces.Dict) else next(iter(found.values()))


def leaves_of(space: gym.Space[Any]) -> list[tuple[str, gym.Space[Any]]]:
    """Return the parts of an observation, each with its name."""
    if isinstance(space, gym.spaces.Dict):
        return list(space.items())
    return [(IMAGE if _is_image(space) else OBSERVATION, space)]


def _is_image(space: gym.Space[Any]) -> bool:
    return isinstance(space, gym.spaces.Box) and len(space.shape) == 3 and space.dtype == np.uint8
