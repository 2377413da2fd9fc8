"""Does a policy fulfil the contract of `Policy`?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from vla_eval.core import (
    ActionChunk,
    BatchPolicy,
    EpisodeStart,
    FloatArray,
    Observation,
    ObservationWindow,
    Policy,
)
from vla_eval.errors import ConformanceError
from vla_eval.specs import EnvSpec, PolicySpec, check_compatible
from vla_eval.testing.claims import claim
from vla_eval.wire.numbers import noise_state

N_INFERENCES = 3
HORIZON_STEPS = 60

SAME = "The same episode seed and observations give the same actions"
FORGET = (
    "Forget everything of a slot in `reset`; draw random numbers from a generator seeded by `episode.seed`."
)
BY_SLOT = "Keep your state by `window.slot`: `reset` begins the given slots only."

Observe = Callable[[int, int], Observation]


@dataclass(slots=True, kw_only=True)
class _Episode:
    """An episode in a slot; it begins when the others have had so many inferences."""

    slot: int
    seed: int
    begins_after: int = 0
    chunks: list[ActionChunk] = field(default_factory=list)


def check_policy(
    make: Callable[[], Policy],
    env: EnvSpec,
    *,
    observe: Observe | None = None,
    instruction: str = "pick up the red cube",
    report: Callable[[str], None] = lambda requirement: None,
) -> list[str]:
    """Raise `ConformanceError` unless the policies that `make` returns fulfil the contract.

    Args:
        make: returns a new policy of the same weights at each call, for two slots.
        env: the environment in which the policy will be run.
        observe: (seed, step) -> an observation, for a policy that needs more than noise in the declared
            shapes (privileged ones do).
        instruction: the instruction that the policy gets.
        report: called with each requirement that is met, as soon as that is known.

    Returns:
        The requirements, all of which are met.

    Raises:
        SpecMismatchError: the policy needs what the environment does not provide.
        ConformanceError: a requirement is not met.
    """
    policy = make()
    check_compatible(policy.spec, env)
    runs = _Runs(policy.spec, env, observe, instruction)
    met = _Requirements(report)
    reads = ", ".join((*policy.spec.cameras, *policy.spec.states)) or "nothing"
    met.note(f"{env.task} provides what it reads: {reads}.")
    alone = [runs.run(policy, _Episode(slot=slot, seed=seed))[0] for slot, seed in enumerate((2, 1))]
    met.note(f"A chunk is float32 of shape {runs.chunk_shape} and finite.")
    met.note("It leaves the observations as they are.")
    met.note("No two chunks share a buffer.")
    _check_independence(make, policy, runs, alone, met)
    return met.requirements


def _check_independence(
    make: Callable[[], Policy], policy: Policy, runs: "_Runs", alone: Sequence[_Episode], met: "_Requirements"
) -> None:
    """Compare episodes in all kinds of company with the same ones alone."""

    def first() -> _Episode:
        return _Episode(slot=0, seed=2)

    def second(begins_after: int = 0) -> _Episode:
        return _Episode(slot=1, seed=1, begins_after=begins_after)

    met.same(alone, runs.run(policy, first()), "after another episode", FORGET)
    runs.run(policy, _Episode(slot=1, seed=3))
    met.same(alone, runs.run(policy, second()), "after another episode in the same slot", FORGET)
    met.same(alone, runs.run(make(), second()), "in a new policy", FORGET)
    met.same(alone, runs.run(policy, first(), second()), "beside another episode", BY_SLOT)
    meanwhile = runs.run(policy, first(), second(begins_after=1))
    met.same(alone, meanwhile, "when another episode begins or ends meanwhile", BY_SLOT)


class _Requirements:
    """The requirements that are met so far."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self.requirements: list[str] = []
        self._report = report

    def note(self, requirement: str) -> None:
        """Add one."""
        self.requirements.append(requirement)
        self._report(requirement)

    def same(self, alone: Sequence[_Episode], found: Sequence[_Episode], where: str, advice: str) -> None:
        """Require the actions that each episode has alone; `alone` is in the order of the slots."""
        for episode in found:
            pairs = zip(alone[episode.slot].chunks, episode.chunks, strict=True)
            equal = all(np.array_equal(a.actions, b.actions) for a, b in pairs)
            claim(equal, f"{SAME} {where}.", advice=advice)
        self.note(f"{SAME} {where}.")


class _Runs:
    """Runs episodes of a policy without a simulator."""

    def __init__(self, spec: PolicySpec, env: EnvSpec, observe: Observe | None, instruction: str) -> None:
        self.chunk_shape = (spec.chunk_size, len(env.action.dims))
        self._spec, self._instruction, self._dims = spec, instruction, env.action.dims
        self._observe = observe or (lambda seed, step: _noise(spec, env, seed, step))

    def run(self, policy: Policy, *episodes: _Episode) -> Sequence[_Episode]:
        """Fill in the chunks of the episodes, which are predicted side by side."""
        for turn in range(N_INFERENCES + max(episode.begins_after for episode in episodes)):
            begins = [one for one in episodes if one.begins_after == turn]
            if begins:
                policy.reset([self._start(episode) for episode in begins])
            due = [one for one in episodes if one.begins_after <= turn and len(one.chunks) < N_INFERENCES]
            for episode, chunk in zip(due, self._act(policy, due), strict=True):
                self._check(chunk, earlier=episode.chunks, seed=episode.seed)
                episode.chunks.append(chunk)
        return episodes

    def _start(self, episode: _Episode) -> EpisodeStart:
        return EpisodeStart(
            slot=episode.slot,
            row=episode.slot,
            task="check",
            seed=episode.seed,
            run=0,
            instruction=self._instruction,
            horizon_steps=HORIZON_STEPS,
        )

    def _act(self, policy: Policy, due: Sequence[_Episode]) -> list[ActionChunk]:
        windows = [self._window(episode) for episode in due]
        before = [_bytes(window) for window in windows]
        if isinstance(policy, BatchPolicy):
            chunks = policy.act_batch(windows)
        else:
            chunks = [policy.act(window) for window in windows]
        unchanged = [_bytes(window) for window in windows] == before
        claim(unchanged, "A policy leaves the observations as they are.", advice="Change a copy.")
        return chunks

    def _window(self, episode: _Episode) -> ObservationWindow:
        size = self._spec.chunk_size
        step = len(episode.chunks) * size
        first = max(step - size + 1, 0) if self._spec.reads == "every" else step
        frames = tuple(self._observe(episode.seed, s) for s in range(first, step + 1))
        return ObservationWindow(slot=episode.slot, frames=frames)

    def _check(self, chunk: ActionChunk, *, earlier: Sequence[ActionChunk], seed: int) -> None:
        actions = chunk.actions
        claim(
            actions.shape == self.chunk_shape and actions.dtype == np.float32,
            f"A chunk is float32 of shape {self.chunk_shape}.",
            f"{actions.dtype} of shape {actions.shape}",
            advice="The shape is (chunk_size, dimensions of an action).",
        )
        self._check_finite(actions, seed=seed, step=len(earlier) * self._spec.chunk_size)
        shared = any(np.shares_memory(one.actions, actions) for one in earlier)
        claim(
            not shared,
            "Two chunks must not share a buffer: the first would change.",
            advice="Return a new array each time.",
        )

    def _check_finite(self, actions: FloatArray, *, seed: int, step: int) -> None:
        wrong = np.argwhere(~np.isfinite(actions))
        if len(wrong):
            row, column = (int(index) for index in wrong[0])
            raise ConformanceError(
                f"Actions are not finite: {actions[row, column]} in row {row}, dimension "
                f"'{self._dims[column]}', of the chunk at step {step} (seed {seed}); {len(wrong)} of "
                f"{actions.size} numbers."
            )


def _noise(spec: PolicySpec, env: EnvSpec, seed: int, step: int) -> Observation:
    rng = np.random.default_rng((seed, step))
    cameras = [camera for camera in env.cameras if camera.name in spec.cameras]
    return Observation(
        step=step,
        images={c.name: rng.integers(0, 256, (c.height_px, c.width_px, 3), dtype=np.uint8) for c in cameras},
        state={s.name: noise_state(rng, s.dims) for s in env.states},
    )


def _bytes(window: ObservationWindow) -> list[bytes]:
    return [a.tobytes() for f in window.frames for group in (f.images, f.state) for a in group.values()]
