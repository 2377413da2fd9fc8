"""Run any LeRobot policy in our loop: frames in, whole chunks out; see docs/lerobot_policies.md.

The policy's own queues are not used, and the frames of an episode are kept here, per slot, at control rate.
Types that collect their frames themselves are asked for one action per step (`select_step`).
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple  # lerobot is untyped

import numpy as np
import torch
from torch import Tensor

from vla_eval.checkpoints.bases import no_weights
from vla_eval.checkpoints.files import read_facts
from vla_eval.checkpoints.loading import LoadedPolicy, LoadOptions, load_checkpoint
from vla_eval.checkpoints.plain_errors import plain_errors
from vla_eval.checkpoints.policy_types import asked_for_steps, chunk_size, history, noise_shape
from vla_eval.checkpoints.trained_with import Asked, differences, refuse_differences
from vla_eval.core import ActionChunk, EpisodeStart, MemoryArrays, ObservationWindow
from vla_eval.errors import InvalidActionError, SpecMismatchError
from vla_eval.features import ACTION_KEY, CAMERA_KEYS, STATE_KEY, StateKind, camera_key
from vla_eval.models.episodes.memory import memory_of, recall, remembers, remembers_in_rows, remembers_singly
from vla_eval.models.episodes.named_memory import MemoryLayout
from vla_eval.models.episodes.running import (
    Episode,
    Frame,
    batch_of,
    begun_queues,
    frames_in_time,
    given_noise,
    in_rows,
    select_step,
)
from vla_eval.models.families import family_of
from vla_eval.models.shared.earlier_frames import FrameMemory
from vla_eval.models.shared.tokens_read import Readings
from vla_eval.policies.compiled import Compilation
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.compiling import begin_pass, compile_network, warm_up
from vla_eval.policies.lerobot.device import autocast, choose_device, cuda_devices
from vla_eval.policies.lerobot.inputs import InputMap, InputOptions, check_training, input_map
from vla_eval.policies.lerobot.joining import Committed, Joining, joining_of
from vla_eval.specs import EnvSpec, PolicySpec


class _Inferred(NamedTuple):
    """A chunk, and what the policy remembers now; None if it has no memory."""

    chunk: ActionChunk
    memory: Any


class LeRobotPolicy:
    """`Policy` around a loaded LeRobot policy; see the module's text.

    Args:
        batch: infer for all due slots in one forward pass; None: if there are several slots and the
            policy can. Sums are then made in another order, so that actions agree with those of a pass
            of its own only up to rounding.
        is_compiled: whether its network compiles itself, see `compile_network`.
        n_slots: how many rows a pass has, due or not: with the same shape and the same place in it, an
            episode's actions are the same bits whatever the other rows are. Its place is `EpisodeStart.row`;
            its state is kept by its slot, and there may be more slots than rows.
    """

    def __init__(
        self,
        name: str,
        loaded: LoadedPolicy,
        inputs: InputMap,
        *,
        batch: bool | None = False,
        is_compiled: bool = False,
        n_slots: int = 1,
        joining: Joining | None = None,
    ) -> None:
        self._loaded, self._inputs, self._joining = loaded, inputs, joining
        self._remembers = remembers(loaded.policy)
        self._by_step = asked_for_steps(loaded.config.type)
        self._earlier = _earlier_frames(loaded.config)
        self._deltas = history(loaded.config)
        self._masks_history = bool(getattr(loaded.config, "masks_history", False))
        self._noise_shape = noise_shape(loaded.config)
        draws_nothing = family_of(loaded.config.type).draws_nothing or getattr(
            loaded.policy, "draws_nothing", False
        )
        can_batch = draws_nothing or self._noise_shape is not None
        if batch and not can_batch:
            raise SpecMismatchError(
                f"policy '{name}' (type '{loaded.config.type}') draws random numbers that cannot be given "
                f"from outside: in one pass the episodes would depend on each other. Leave `batch` out of "
                "its recipe."
            )
        if batch and self._remembers and not remembers_in_rows(loaded.policy):
            raise SpecMismatchError(
                f"policy '{name}' (type '{loaded.config.type}') has `remember` but no `begin_memory`, which "
                "says what the memory of several episodes is. Leave `batch` out of its recipe, or add the "
                "method (docs/lerobot_policies.md)."
            )
        if batch is None:
            batch = n_slots > 1 and can_batch and (not self._remembers or remembers_in_rows(loaded.policy))
        # One episode that remembers is shown all its new frames at once, which is faster.
        self._batch = batch and (n_slots > 1 or not self._remembers)
        self._n_slots, self._is_compiled = n_slots, is_compiled
        self._slots: dict[int, Episode] = {}
        self._layout = self._memory_layout(name)
        self._readings = Readings()
        self.readings = self._readings.known
        self.proprioception = inputs.state
        reads_more = self._remembers or self._by_step or self._earlier is not None or len(self._deltas) > 1
        self.spec = PolicySpec(
            name=name,
            reads="every" if reads_more else "last",
            cameras=tuple(inputs.cameras),
            states=inputs.states,
            chunk_size=chunk_size(loaded.config),
            reads_committed=joining is not None,
            has_memory=self._layout is not None and not self._layout.is_empty,
        )

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin these episodes; nothing of their slots' earlier ones is kept."""
        for episode in episodes:
            self._slots[episode.slot] = Episode(start=episode, earlier=self._earlier)

    def forget(self, slots: Sequence[int]) -> None:
        """Release the frames and the memory of these slots."""
        for slot in slots:
            self._slots.pop(slot, None)

    def get_memory(self, slot: int) -> MemoryArrays:
        """Return what is kept of a slot's episode; see `MemoryLayout` for the names."""
        return self._readable().arrays(self._slots[slot])

    def set_memory(self, slot: int, memory: MemoryArrays) -> None:
        """Put a memory in place of that of a slot's episode."""
        self._slots[slot] = self._readable().replaced(self._slots[slot], memory)

    def _readable(self) -> MemoryLayout:
        if self._layout is None:
            raise SpecMismatchError(
                f"policy '{self.spec.name}' (type '{self._loaded.config.type}') has `remember` but no "
                "`begin_memory`, which says what its memory is: it can be neither read nor replaced. Add the "
                "method (docs/lerobot_policies.md)."
            )
        return self._layout

    def _memory_layout(self, name: str) -> MemoryLayout | None:
        """Return what is kept between inferences; None: what the policy keeps is not known."""
        policy = self._loaded.policy
        if self._remembers and not remembers_in_rows(policy):
            return None
        fields = (*self._inputs.cameras.values(), *([] if self._inputs.state is None else [STATE_KEY]))
        return MemoryLayout(
            policy=name,
            begun=memory_of(policy.begin_memory(1), 0) if self._remembers else None,
            has_axis=not self._batch and not remembers_singly(policy),
            queues=begun_queues(policy) if self._by_step else None,
            n_frames=-min(self._deltas, default=0),
            fields=fields,
            has_earlier=self._earlier is not None,
        )

    def warm_up(self, env: EnvSpec, sentences: Sequence[str]) -> Compilation | None:
        """Compile for these sentences, in the thread that will ask it; None: it is not to be compiled."""
        if not self._is_compiled:
            return None
        precision = Counter(str(x.dtype).removeprefix("torch.") for x in self._loaded.policy.parameters())
        ((most, _),) = precision.most_common(1)
        return warm_up(self, env, sentences, n_rows=self._n_slots if self._batch else 1, precision=most)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Infer for one episode."""
        return self.act_batch([window])[0]

    def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        """Infer for each window; each draws its own, and refuses a row that is not there or is taken."""
        due = [self._due(window) for window in windows]
        inferred: dict[int, _Inferred] = {}
        for episodes in alike(due):
            found = self._infer_alike(episodes)
            inferred.update(zip((one.start.slot for one in episodes), found, strict=True))
        # Only now: a call that raises leaves all episodes as they were, and may be made again.
        for episode in due:
            memory = inferred[episode.start.slot].memory
            self._slots[episode.start.slot] = replace(episode, unseen=(), memory=memory, committed=None)
        return [inferred[episode.start.slot].chunk for episode in due]

    def _due(self, window: ObservationWindow) -> Episode:
        shown = self._slots[window.slot].shown(
            [self._inputs.tensors(observation) for observation in window.frames],
            step=window.last.step,
            n_kept=1 - min(self._deltas, default=0),
        )
        return replace(shown, committed=window.committed)

    def _infer_alike(self, due: Sequence[Episode]) -> list[_Inferred]:
        """Infer for episodes that can share a pass."""
        if not self._batch:
            return [self._infer([episode])[0] for episode in due]
        if self._n_slots == 1:
            return self._infer(due)
        of_rows = self._infer(in_rows(due, self._n_slots))
        return [of_rows[episode.start.row] for episode in due]

    @torch.no_grad()
    def _infer(self, rows: Sequence[Episode]) -> list[_Inferred]:
        policy, config = self._loaded.policy, self._loaded.config
        seeds = [episode.seed() for episode in rows]
        devices = cuda_devices(config.device)
        heard = self._readings.of(row.start.instruction for row in rows)
        with torch.random.fork_rng(devices=devices), autocast(config), self._loaded.acting(), heard:
            torch.manual_seed(seeds[0])
            if self._is_compiled:
                begin_pass(config.device)
            policy.reset()  # whatever a policy keeps by itself would be shared by all slots
            extra: dict[str, Any] = {}
            if self._noise_shape is not None:
                extra["noise"] = given_noise(seeds, self._noise_shape).to(config.device)
            memories: list[Any] = [None] * len(rows)
            if self._remembers:
                extra["memory"], memories = self._recall(rows)
            frames = [episode.read(self._deltas, masks_history=self._masks_history) for episode in rows]
            told = Committed.of([row.committed for row in rows]) if self._joining else None
            actions = {} if told is None else {ACTION_KEY: told.actions}
            batch = self._loaded.preprocessor({**batch_of(frames, rows), **actions})
            if told is not None and self._joining is not None:
                extra |= told.arguments(batch, self._joining, self._loaded, policy=self.spec.name)
            if self._by_step:
                (episode,) = rows
                if len(episode.unseen) != 1:
                    raise InvalidActionError(
                        f"policy '{self.spec.name}' (type '{config.type}') is asked for one action at each "
                        f"control step; expected one new frame, found {len(episode.unseen)}. Ask it with "
                        "n_action_steps 1."
                    )
                raw, *memories = select_step(policy, batch, episode.memory)
            else:
                raw = policy.predict_action_chunk(batch, **extra)
            actions = self._loaded.postprocessor(raw)
        chunks = self._chunks(actions, len(rows))
        return [_Inferred(*one) for one in zip(chunks, memories, strict=True)]

    def _recall(self, rows: Sequence[Episode]) -> tuple[Any, list[Any]]:
        """Return what the policy remembers now: of all rows, as it takes it, and of each."""

        def preprocessed(frames: Sequence[Frame]) -> dict[str, Any]:
            batch: dict[str, Any] = self._loaded.preprocessor(batch_of(frames, rows))
            return batch

        policy = self._loaded.policy
        if not self._batch and not remembers_singly(policy):
            (episode,) = rows
            memory = policy.remember(preprocessed([frames_in_time(episode.unseen)]), episode.memory)
            return memory, [memory]
        memory = recall(policy, rows, preprocessed)
        return memory, [memory_of(memory, row) for row in range(len(rows))]

    def _chunks(self, actions: Tensor, n_rows: int) -> list[ActionChunk]:
        rows = actions.detach().to("cpu", torch.float32).numpy()
        expected = (n_rows, self.spec.chunk_size)
        if rows.shape[:2] != expected:
            raise InvalidActionError(
                f"policy '{self.spec.name}': expected chunks of shape {expected} before the action's "
                f"dimensions, found {rows.shape}. Its `action_delta_indices` and `predict_action_chunk` "
                "disagree."
            )
        return [ActionChunk(actions=np.ascontiguousarray(row)) for row in rows]


def alike(episodes: Sequence[Episode]) -> list[list[Episode]]:
    """Return the episodes in groups with as many committed steps: each is a pass of its own."""
    groups: dict[tuple[int, int] | None, list[Episode]] = {}
    for episode in episodes:
        told = episode.committed
        groups.setdefault(None if told is None else (len(told.actions), told.n_frozen), []).append(episode)
    return list(groups.values())


def _earlier_frames(config: Any) -> FrameMemory | None:
    """Return the memory of a policy that is shown earlier frames before the first one; None: it is not."""
    choice = config.frame_choice() if hasattr(config, "frame_choice") else None
    return None if choice is None else FrameMemory(choice=choice, cameras=tuple(config.memory_cameras))


def _default_cameras(context: PolicyContext) -> dict[str, str]:
    """Return camera -> field of the datasets that are recorded with it."""
    return {**CAMERA_KEYS, **{camera.name: camera_key(camera.name) for camera in context.env.cameras}}


def make_lerobot(
    context: PolicyContext,
    *,
    checkpoint: str | None = None,
    cameras: Mapping[str, str] | None = None,
    state: StateKind | None = None,
    absent_cameras: Sequence[str] = (),
    device: str = "auto",
    dtype: Literal["float32", "bfloat16"] | None = None,
    tokenizer: str | None = None,
    base_checkpoint: str | None = None,
    batch: bool | None = None,
    compile: bool = False,
) -> LeRobotPolicy:
    """Make a policy from a LeRobot checkpoint; `docs/lerobot_policies.md` explains the arguments."""
    if checkpoint is None:
        raise no_weights(context.name)
    options = LoadOptions(
        device=choose_device(device), dtype=dtype, tokenizer=tokenizer, base_checkpoint=base_checkpoint
    )
    loaded = load_checkpoint(Path(checkpoint), options)
    if compile:
        compile_network(loaded, policy=context.name)
    asked = InputOptions(
        cameras=_default_cameras(context) if cameras is None else cameras,
        state=state,
        absent_cameras=absent_cameras,
    )
    with plain_errors(loaded.folder, loaded.config.type, "cannot be used"):
        facts = read_facts(loaded.folder)
        # First what is wrong by itself: another control mode has other dimensions, too.
        refuse_differences(differences(facts, Asked(context.env)), policy=context.name, task=context.env.task)
        inputs = input_map(loaded.config, loaded.preprocessor, asked, context.env, policy=context.name)
        check_training(facts, inputs, loaded, context.env, policy=context.name)
        joining = joining_of(loaded, context.chunking, policy=context.name, is_compiled=compile)
        return LeRobotPolicy(
            context.name,
            loaded,
            inputs,
            batch=batch,
            is_compiled=compile,
            n_slots=context.n_slots,
            joining=joining,
        )
