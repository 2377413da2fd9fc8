"""Does an environment fulfil the contract of `SimEnv`?"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from vla_eval.core import FloatArray, Observation, SimEnv, StepResult
from vla_eval.specs import EnvSpec
from vla_eval.testing.claims import claim, same_observation

SLOT = 0


def check_env(make: Callable[[], SimEnv], *, n_steps: int = 8, renders: bool = True) -> None:
    """Raise `ConformanceError` unless the environments that `make` returns fulfil the contract.

    Args:
        make: returns a new environment of the same settings at each call.
        n_steps: number of control steps of the check's episodes.
        renders: whether the environment can render images; otherwise images are not checked.
    """
    env = make()
    try:
        action = env.spec.action
        drawn = np.random.default_rng(0).uniform(action.low, action.high, (n_steps, len(action.dims)))
        actions = drawn.astype(np.float32)
        first = _episode(env, 1, actions, every=1 if renders else None)
        for result in first:
            _check_observation(result.observation, env.spec, with_images=renders)
        _check_buffers(first)
        _check_hold(env)
        others = [_episode(env, seed, actions, every=1 if renders else None) for seed in (2, 3, 4)]
        differ = any(
            not same_observation(one.observation, two.observation)
            for other in others
            for one, two in zip(first, other, strict=True)
        )
        claim(differ, "Different seeds must give different episodes.")
        _check_repetition(
            first, _episode(env, 1, actions, every=3 if renders else None), "a used environment"
        )
        fresh = make()
        try:
            repeated = _episode(fresh, 1, actions, every=1 if renders else None)
            _check_repetition(first, repeated, "a fresh environment")
        finally:
            fresh.close()
    finally:
        env.close()


def _episode(env: SimEnv, seed: int, actions: FloatArray, *, every: int | None) -> list[StepResult]:
    """Run the actions; render each `every`-th step, or none."""
    results = [env.reset({SLOT: seed}, render=every is not None)[SLOT]]
    for step, action in enumerate(actions, start=1):
        wanted = frozenset({SLOT}) if every is not None and step % every == 0 else frozenset[int]()
        results.append(env.step({SLOT: action}, render=wanted)[SLOT])
        found = results[-1].observation
        claim(found.step == step, "Observation.step counts control steps since reset.", f"{found.step}")
        claim(
            bool(found.images) == bool(wanted),
            "An observation holds images exactly when they were asked for.",
            f"images {sorted(found.images)} at step {step}, asked for: {bool(wanted)}",
        )
    return results


def _check_observation(observation: Observation, spec: EnvSpec, *, with_images: bool) -> None:
    for state in spec.states:
        value = observation.state.get(state.name)
        claim(value is not None, f"EnvSpec.states names '{state.name}', so each observation has it.")
        assert value is not None
        claim(
            value.shape == (len(state.dims),) and value.dtype == np.float32,
            f"State '{state.name}' is float32 of shape ({len(state.dims)},).",
            f"{value.dtype} of shape {value.shape}",
        )
        claim(bool(np.isfinite(value).all()), f"State '{state.name}' is finite.")
    for camera in spec.cameras if with_images else ():
        image = observation.images.get(camera.name)
        claim(image is not None, f"EnvSpec.cameras names '{camera.name}', so a rendered observation has it.")
        assert image is not None
        expected = (camera.height_px, camera.width_px, 3)
        claim(
            image.shape == expected and image.dtype == np.uint8,
            f"Camera '{camera.name}' gives uint8 of shape {expected}.",
            f"{image.dtype} of shape {image.shape}",
        )


def _check_buffers(results: list[StepResult]) -> None:
    for earlier, later in pairwise(results):
        for name, value in earlier.observation.state.items():
            shared = np.shares_memory(value, later.observation.state[name])
            claim(not shared, f"State '{name}' of two steps must not share a buffer: the first would change.")
        for name, image in earlier.observation.images.items():
            shared = np.shares_memory(image, later.observation.images[name])
            claim(not shared, f"Images of '{name}' of two steps must not share a buffer.")


def _check_hold(env: SimEnv) -> None:
    env.reset({SLOT: 1}, render=False)
    action = env.hold_action(SLOT)
    spec = env.spec.action
    claim(
        action.shape == (len(spec.dims),) and action.dtype == np.float32,
        f"hold_action gives float32 of shape ({len(spec.dims)},).",
        f"{action.dtype} of shape {action.shape}",
    )
    claim(bool(((action >= spec.low) & (action <= spec.high)).all()), "hold_action lies in the action space.")


def _check_repetition(first: list[StepResult], again: list[StepResult], where: str) -> None:
    for one, two in zip(first, again, strict=True):
        claim(
            same_observation(one.observation, two.observation) and one.status == two.status,
            f"The same seed and actions give bit-equal episodes in {where}, rendered or not.",
            f"a difference at step {one.observation.step}",
        )
