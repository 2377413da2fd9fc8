"""Does a policy fulfil the contract of `Policy`?"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
    RememberingPolicy,
)
from vla_eval.errors import ConformanceError, VlaEvalError
from vla_eval.specs import EnvSpec, PolicySpec, check_compatible
from vla_eval.testing.claims import claim
from vla_eval.wire.noise import PAIRS, ROWS, SEEDS, look_at, n_inferences, noise_image, noise_state
from vla_eval.workers.messages import own_line

HORIZON_STEPS = 60

SAME = "The same episode seed and observations give the same actions"
FORGET = (
    "Forget everything of a slot in `reset`; draw random numbers from a generator seeded by `episode.seed`."
)
CONTINUED = "when its memory is read, lost, and put back"
COMPLETE = (
    "`get_memory` returns copies of all that is kept between two inferences; `set_memory` puts them in place."
)
BY_SLOT = "Keep your state by `window.slot`: `reset` begins the given slots only."

Observe = Callable[[int, int], Observation]


@dataclass(slots=True, kw_only=True)
class _Episode:
    """An episode; it begins when the others have had so many inferences."""

    seed: int
    begins_after: int = 0
    chunks: list[ActionChunk] = field(default_factory=list)

    @property
    def slot(self) -> int:
        """Its slot, which is also its row."""
        return ROWS[self.seed]


def check_policy(
    make: Callable[[], Policy],
    env: EnvSpec,
    *,
    observe: Observe | None = None,
    instruction: str = "pick up the red cube",
    other_instruction: str = "touch the cube that was shown",
    report: Callable[[str], None] = lambda requirement: None,
) -> list[str]:
    """Raise `ConformanceError` unless the policies that `make` returns fulfil the contract.

    Args:
        make: returns a new policy of the same weights at each call, for two slots.
        env: the environment in which the policy will be run.
        observe: (seed, step) -> an observation, for a policy that needs more than noise in the declared
            shapes (privileged ones do).
        instruction: the instruction that the policy gets.
        other_instruction: what it gets in half of the episodes; a policy that knows one sentence only, and
            raises an error for others, always gets `instruction`.
        report: called with each requirement that is met, as soon as that is known.

    Returns:
        The requirements, all of which are met.

    Raises:
        SpecMismatchError: the policy needs what the environment does not provide.
        ConformanceError: a requirement is not met.
    """
    policy = make()
    check_compatible(policy.spec, env)
    runs = _Runs(policy.spec, env, observe, (instruction, other_instruction))
    met = _Requirements(report)
    reads = ", ".join((*policy.spec.cameras, *policy.spec.states)) or "nothing"
    met.note(f"{env.task} provides what it reads: {reads}.")
    met.alone = {seed: runs.alone(policy, seed) for seed in SEEDS}
    if runs.problem:
        met.note(f"Not tried: episodes with different sentences side by side. {runs.problem}")
    met.note(f"A chunk is float32 of shape {runs.chunk_shape} and finite.")
    met.note("It leaves the observations as they are.")
    met.note("No two chunks share a buffer.")
    _check_independence(make, policy, runs, met)
    return met.requirements


def _check_independence(
    make: Callable[[], Policy], policy: Policy, runs: "_Runs", met: "_Requirements"
) -> None:
    """Compare episodes in all kinds of company with the same ones alone."""
    met.same(runs.run(policy, _Episode(seed=0)), "after another episode", FORGET)
    runs.run(policy, _Episode(seed=2))
    met.same(runs.run(policy, _Episode(seed=1)), "after another episode in the same slot", FORGET)
    met.same(runs.run(make(), _Episode(seed=3)), "in a new policy", FORGET)
    beside: list[_Episode] = []
    for turn, pair in enumerate(PAIRS):
        episodes = [_Episode(seed=seed) for seed in pair]
        beside += runs.run(policy, *episodes, alternating=turn == len(PAIRS) - 1)
    met.same(beside, "beside another episode", BY_SLOT)
    in_turn = (0, 0), (1, 1), (3, runs.n_inferences)  # the last begins where the first has ended
    meanwhile = [_Episode(seed=seed, begins_after=turn) for seed, turn in in_turn]
    met.same(runs.run(policy, *meanwhile), "when another episode begins or ends meanwhile", BY_SLOT)
    if policy.spec.has_memory:
        _check_memory(make, policy, runs, met)


def _check_memory(make: Callable[[], Policy], policy: Policy, runs: "_Runs", met: "_Requirements") -> None:
    """Compare episodes whose memory was moved with the same ones left alone."""
    for where, owner in (("", policy), (", by a new policy", make())):
        claim(
            isinstance(policy, RememberingPolicy) and isinstance(owner, RememberingPolicy),
            "A policy whose spec has `has_memory` has `get_memory` and `set_memory`.",
            advice="Add them, or leave `has_memory` out.",
        )
        assert isinstance(policy, RememberingPolicy)
        assert isinstance(owner, RememberingPolicy)
        after = (0, 1, 2, runs.n_inferences - 1)
        moved = [runs.moved(policy, owner, seed, after=n) for seed, n in zip(SEEDS, after, strict=True)]
        met.same(moved, f"{CONTINUED}{where}", COMPLETE)


class _PolicyError(ConformanceError):
    """The policy itself raised an exception."""


@contextmanager
def _named(method: str, episodes: Sequence[_Episode], *, chunk_size: int) -> Iterator[None]:
    """Say of an exception of the policy where its code was, and in which episode and step."""
    try:
        yield
    except VlaEvalError:
        raise
    except Exception as exc:
        where = ", ".join(f"step {len(one.chunks) * chunk_size} of seed {one.seed}" for one in episodes)
        line = own_line(exc)
        raise _PolicyError(
            f"`{method}` raised {type(exc).__name__}: {exc}{f' ({line})' if line else ''}, at {where}."
        ) from exc


class _Requirements:
    """The requirements that are met so far."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self.requirements: list[str] = []
        self.alone: dict[int, list[ActionChunk]] = {}  # seed -> the chunks of its episode
        self._report = report

    def note(self, requirement: str) -> None:
        """Add one."""
        self.requirements.append(requirement)
        self._report(requirement)

    def same(self, found: Sequence[_Episode], where: str, advice: str) -> None:
        """Require the actions that each episode has alone."""
        for episode in found:
            pairs = zip(self.alone[episode.seed], episode.chunks, strict=True)
            equal = all(np.array_equal(a.actions, b.actions) for a, b in pairs)
            claim(equal, f"{SAME} {where}.", advice=advice)
        self.note(f"{SAME} {where}.")


class _Runs:
    """Runs episodes of a policy without a simulator."""

    def __init__(
        self, spec: PolicySpec, env: EnvSpec, observe: Observe | None, instructions: tuple[str, str]
    ) -> None:
        self.chunk_shape = (spec.chunk_size, len(env.action.dims))
        self.n_inferences = n_inferences(spec.chunk_size)
        self._spec, self._instructions, self._dims = spec, instructions, env.action.dims
        self.problem: str | None = None
        self._observe = observe or (lambda seed, step: _noise(spec, env, seed, step))

    def run(self, policy: Policy, *episodes: _Episode, alternating: bool = False) -> Sequence[_Episode]:
        """Fill in the chunks of the episodes, which are predicted side by side, in this or changing order."""
        for turn in range(self.n_inferences + max(episode.begins_after for episode in episodes)):
            begins = [one for one in episodes if one.begins_after == turn]
            if begins:
                self.begin(policy, begins)
            due = [one for one in episodes if 0 <= turn - one.begins_after < self.n_inferences]
            if alternating and turn % 2:
                due.reverse()
            self.infer(policy, due)
        return episodes

    def begin(self, policy: Policy, episodes: Sequence[_Episode]) -> None:
        """Reset a policy for these episodes."""
        with _named("reset", episodes, chunk_size=self._spec.chunk_size):
            policy.reset([self._start(episode) for episode in episodes])

    def infer(self, policy: Policy, episodes: Sequence[_Episode]) -> None:
        """Add the next chunk of each episode."""
        for episode, chunk in zip(episodes, self._act(policy, episodes), strict=True):
            self._check(chunk, earlier=episode.chunks, seed=episode.seed)
            episode.chunks.append(chunk)

    def moved(
        self, policy: RememberingPolicy, owner: RememberingPolicy, seed: int, *, after: int
    ) -> _Episode:
        """Return an episode; its memory goes from one policy to the other after so many inferences.

        In between, another episode runs in its slot of both.
        """
        episode = _Episode(seed=seed)
        self.begin(policy, [episode])
        for _ in range(after):
            self.infer(policy, [episode])
        with _named("get_memory", [episode], chunk_size=self._spec.chunk_size):
            memory = policy.get_memory(episode.slot)
        other = next(one for one in SEEDS if one != seed and ROWS[one] == ROWS[seed])
        for one in (policy, owner):
            self.run(one, _Episode(seed=other))
        self.begin(owner, [episode])
        with _named("set_memory", [episode], chunk_size=self._spec.chunk_size):
            owner.set_memory(episode.slot, memory)
        while len(episode.chunks) < self.n_inferences:
            self.infer(owner, [episode])
        return episode

    def alone(self, policy: Policy, seed: int) -> list[ActionChunk]:
        """Return an episode's chunks alone; a policy that refuses a sentence gets its own."""
        own, given = self._instructions[0], self._instructions[seed % 2]
        try:
            return self.run(policy, _Episode(seed=seed))[0].chunks
        except _PolicyError as exc:
            if given == own:
                raise
            self._instructions = (own, own)
            self.problem = f"With “{given}”, {exc}"
            return self.run(policy, _Episode(seed=seed))[0].chunks

    def _start(self, episode: _Episode) -> EpisodeStart:
        return EpisodeStart(
            slot=episode.slot,
            row=episode.slot,
            task="check",
            seed=episode.seed,
            run=0,
            instruction=self._instructions[episode.seed % 2],
            horizon_steps=HORIZON_STEPS,
        )

    def _act(self, policy: Policy, due: Sequence[_Episode]) -> list[ActionChunk]:
        windows = [self._window(episode) for episode in due]
        before = [_bytes(window) for window in windows]
        if isinstance(policy, BatchPolicy):
            with _named("act_batch", due, chunk_size=self._spec.chunk_size):
                chunks = policy.act_batch(windows)
        else:
            chunks = []
            for episode, window in zip(due, windows, strict=True):
                with _named("act", [episode], chunk_size=self._spec.chunk_size):
                    chunks.append(policy.act(window))
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
        claim(isinstance(chunk, ActionChunk), "`act` returns an ActionChunk.", type(chunk).__name__)
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
    look = look_at(seed, step, spec.chunk_size)
    cameras = [camera for camera in env.cameras if camera.name in spec.cameras]
    return Observation(
        step=step,
        images={c.name: noise_image(rng, look, c.height_px, c.width_px) for c in cameras},
        state={s.name: noise_state(rng, look, s.dims) for s in env.states},
    )


def _bytes(window: ObservationWindow) -> list[bytes]:
    return [a.tobytes() for f in window.frames for group in (f.images, f.state) for a in group.values()]
