"""Does a policy fulfil the contract of `Policy`?"""

from collections.abc import Callable, Sequence

import numpy as np

from vla_eval.core import ActionChunk, BatchPolicy, EpisodeStart, Observation, ObservationWindow, Policy
from vla_eval.specs import EnvSpec, PolicySpec, check_compatible
from vla_eval.testing.claims import claim

N_INFERENCES = 3
HORIZON_STEPS = 60


def check_policy(
    make: Callable[[], Policy],
    env: EnvSpec,
    *,
    observe: Callable[[int, int], Observation] | None = None,
    instruction: str = "pick up the red cube",
) -> None:
    """Raise `ConformanceError` unless the policies that `make` returns fulfil the contract.

    Args:
        make: returns a new policy of the same weights at each call.
        env: the environment in which the policy will be run.
        observe: (seed, step) -> an observation, for a policy that needs more than noise in the declared
            shapes (privileged ones do).
        instruction: the instruction that the policy gets.

    Raises:
        SpecMismatchError: the policy needs what the environment does not provide.
    """
    policy = make()
    check_compatible(policy.spec, env)
    look = observe or (lambda seed, step: _noise(policy.spec, env, seed, step))
    alone = {seed: _episode(policy, policy.spec, look, [seed], instruction)[0] for seed in (1, 2)}
    for chunks in alone.values():
        for chunk in chunks:
            _check_chunk(chunk, policy.spec, env)
    _claim_equal(alone[1], _episode(policy, policy.spec, look, [1], instruction)[0], "after another episode")
    _claim_equal(alone[1], _episode(make(), policy.spec, look, [1], instruction)[0], "in a new policy")
    together = _episode(policy, policy.spec, look, [2, 1], instruction)
    _claim_equal(alone[2], together[0], "beside another episode")
    _claim_equal(alone[1], together[1], "beside another episode")


def _noise(spec: PolicySpec, env: EnvSpec, seed: int, step: int) -> Observation:
    rng = np.random.default_rng((seed, step))
    cameras = [camera for camera in env.cameras if camera.name in spec.cameras]
    return Observation(
        step=step,
        images={c.name: rng.integers(0, 256, (c.height_px, c.width_px, 3), dtype=np.uint8) for c in cameras},
        state={s.name: rng.uniform(-1, 1, len(s.dims)).astype(np.float32) for s in env.states},
    )


def _episode(
    policy: Policy,
    spec: PolicySpec,
    look: Callable[[int, int], Observation],
    seeds: Sequence[int],
    instruction: str,
) -> list[list[ActionChunk]]:
    """Return the chunks of one episode per seed, predicted side by side."""
    starts = [
        EpisodeStart(
            slot=slot,
            task="check",
            seed=seed,
            run=0,
            instruction=instruction,
            horizon_steps=HORIZON_STEPS,
            row=slot,
        )
        for slot, seed in enumerate(seeds)
    ]
    policy.reset(starts)
    chunks: list[list[ActionChunk]] = [[] for _ in seeds]
    for index in range(N_INFERENCES):
        windows = [_window(spec, look, start, index) for start in starts]
        before = [_bytes(window) for window in windows]
        if isinstance(policy, BatchPolicy):
            answers = policy.act_batch(windows)
        else:
            answers = [policy.act(window) for window in windows]
        claim([_bytes(w) for w in windows] == before, "A policy leaves the observations as they are.")
        for slot, answer in enumerate(answers):
            for earlier in chunks[slot]:
                shared = np.shares_memory(earlier.actions, answer.actions)
                claim(not shared, "Two chunks must not share a buffer: the first would change.")
            chunks[slot].append(answer)
    return chunks


def _window(
    spec: PolicySpec, look: Callable[[int, int], Observation], start: EpisodeStart, index: int
) -> ObservationWindow:
    step = index * spec.chunk_size
    first = max(step - spec.chunk_size + 1, 0) if spec.reads == "every" else step
    return ObservationWindow(
        slot=start.slot, frames=tuple(look(start.seed, s) for s in range(first, step + 1))
    )


def _bytes(window: ObservationWindow) -> list[bytes]:
    return [a.tobytes() for f in window.frames for group in (f.images, f.state) for a in group.values()]


def _check_chunk(chunk: ActionChunk, spec: PolicySpec, env: EnvSpec) -> None:
    expected = (spec.chunk_size, len(env.action.dims))
    claim(
        chunk.actions.shape == expected and chunk.actions.dtype == np.float32,
        f"A chunk is float32 of shape {expected}.",
        f"{chunk.actions.dtype} of shape {chunk.actions.shape}",
    )
    claim(bool(np.isfinite(chunk.actions).all()), "Actions are finite.")


def _claim_equal(first: Sequence[ActionChunk], second: Sequence[ActionChunk], where: str) -> None:
    same = all(np.array_equal(a.actions, b.actions) for a, b in zip(first, second, strict=True))
    claim(same, f"The same episode seed and observations give the same actions {where}.")
