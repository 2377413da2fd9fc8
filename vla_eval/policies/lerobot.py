"""Run any LeRobot policy in our loop: frames in, whole chunks out.

The policy's own queue of actions is never used: `predict_action_chunk` is asked at each inference, and
the loop executes as much of the chunk as it wants. Its own queue of observations is not used either:
the frames of an episode are kept here, per slot, at control rate, however long the chunk is.

Three kinds of policies, told apart by their configuration:

- `observation_delta_indices` is None, or has frames of the future, which only training has (FastWAM): it
  reads the last frame, (B, …) (ACT, π0, π0.5, π0-FAST).
- with indices, such as [-1, 0] or [0]: it gets these frames, (B, T, …), as in training (Diffusion
  Policy, SmolVLA); before the first frame of an episode there is the first frame again. One whose
  configuration says `masks_history = True` gets `FIELD_is_pad`, which marks these frames (Octo).
- with a method `remember(batch, memory) -> memory`: it is given each frame once, in order, batch
  (1, T, …), and its memory of the episode so far (None at its beginning); `predict_action_chunk` then
  gets `memory` (a recurrent policy of your own).
"""

import zlib
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal  # lerobot is untyped

import numpy as np
import torch
from torch import Tensor

from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.errors import CheckpointError, InvalidActionError, SpecMismatchError
from vla_eval.features import StateKind
from vla_eval.policies.bases import first_fetch
from vla_eval.policies.checkpoint import read_facts
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot_inputs import (
    STATES,
    InputMap,
    InputOptions,
    check_training,
    default_cameras,
    input_map,
)
from vla_eval.policies.lerobot_loading import LoadedPolicy, LoadOptions, load_checkpoint
from vla_eval.policies.lerobot_types import DETERMINISTIC, chunk_size, history, noise_shape
from vla_eval.seeding import Stream, generator
from vla_eval.specs import PolicySpec

N_SEED_BITS = 63


@dataclass(slots=True, kw_only=True)
class _Slot:
    """What is known of one running episode."""

    start: EpisodeStart
    frames: deque[dict[str, Tensor]]
    memory: Any = None  # whatever the policy's `remember` returns
    unseen: list[dict[str, Tensor]] = field(default_factory=list)
    step: int = 0


class LeRobotPolicy:
    """`Policy` around a loaded LeRobot policy; see the module's text.

    Args:
        name: for messages.
        loaded: policy and processors.
        inputs: how observations become inputs.
        batch: infer for all due slots in one forward pass; None: if there are several slots and the
            policy can. Sums are then made in another order, so that actions agree with those of a pass
            of its own only up to rounding.
        n_slots: how many slots there are. A pass then has a row for each, due or not: with the same
            shape and the same place in it, an episode's actions are the same bits whoever is beside it.
    """

    def __init__(
        self,
        name: str,
        loaded: LoadedPolicy,
        inputs: InputMap,
        *,
        batch: bool | None = False,
        n_slots: int = 1,
    ) -> None:
        self._loaded, self._inputs = loaded, inputs
        self._remembers = callable(getattr(loaded.policy, "remember", None))
        self._deltas = history(loaded.config)
        self._noise_shape = noise_shape(loaded.config)
        draws_nothing = loaded.config.type in DETERMINISTIC or getattr(loaded.policy, "draws_nothing", False)
        can_batch = draws_nothing or self._noise_shape is not None
        if batch and not can_batch:
            raise SpecMismatchError(
                f"policy '{name}' (type '{loaded.config.type}') draws random numbers that cannot be given "
                f"from outside: in one pass the episodes would depend on each other. Leave `batch` out of "
                "its recipe."
            )
        wants_batch = n_slots > 1 and can_batch if batch is None else batch
        self._batch = wants_batch and not self._remembers
        self._n_slots = n_slots
        self._slots: dict[int, _Slot] = {}
        self.spec = PolicySpec(
            name=name,
            reads="every" if self._remembers or len(self._deltas) > 1 else "last",
            cameras=tuple(inputs.cameras),
            states=STATES if inputs.state is not None else (),
            chunk_size=chunk_size(loaded.config),
        )

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin these episodes; nothing of their slots' earlier ones is kept."""
        for episode in episodes:
            n_kept = 1 - min(self._deltas, default=0)
            self._slots[episode.slot] = _Slot(start=episode, frames=deque(maxlen=n_kept))

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Infer for one episode."""
        return self.act_batch([window])[0]

    def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        """Infer for each window; the draws of an episode are its own."""
        slots = [self._take(window) for window in windows]
        if not self._batch:
            return [self._infer([slot])[0] for slot in slots]
        if self._n_slots == 1:
            return self._infer(slots)
        # A row that nobody is due for repeats another one, and its answer is dropped.
        due = {slot.start.slot: slot for slot in slots}
        chunks = self._infer([due.get(row, slots[0]) for row in range(self._n_slots)])
        return [chunks[slot.start.slot] for slot in slots]

    def _take(self, window: ObservationWindow) -> _Slot:
        slot = self._slots[window.slot]
        frames = [self._inputs.tensors(observation) for observation in window.frames]
        slot.frames.extend(frames)
        slot.unseen = frames
        slot.step = window.last.step
        return slot

    @torch.no_grad()
    def _infer(self, slots: Sequence[_Slot]) -> list[ActionChunk]:
        policy, config = self._loaded.policy, self._loaded.config
        seeds = [_seed(slot) for slot in slots]
        with torch.random.fork_rng(devices=_cuda_devices(config.device)), _autocast(config):
            torch.manual_seed(seeds[0])
            policy.reset()  # whatever a policy keeps by itself would be shared by all slots
            extra: dict[str, Any] = {}
            if self._noise_shape is not None:
                extra["noise"] = torch.stack([_noise(seed, self._noise_shape) for seed in seeds]).to(
                    config.device
                )
            if self._remembers:
                (slot,) = slots
                seen = self._loaded.preprocessor(_batched([_in_time(slot.unseen)], [slot]))
                slot.memory = extra["memory"] = policy.remember(seen, slot.memory)
            batch = self._loaded.preprocessor(_batched([self._frame(slot) for slot in slots], slots))
            actions = self._loaded.postprocessor(policy.predict_action_chunk(batch, **extra))
        return self._chunks(actions, len(slots))

    def _frame(self, slot: _Slot) -> dict[str, Tensor]:
        """Return the frame, or the frames in time, that the next inference reads."""
        if not self._deltas:
            return slot.frames[-1]
        last = len(slot.frames) - 1
        frames = _in_time([slot.frames[max(0, last + delta)] for delta in self._deltas])
        if not getattr(self._loaded.config, "masks_history", False):
            return frames
        # As lerobot's datasets say it: what lies before the episode's beginning is padding.
        is_pad = torch.tensor([last + delta < 0 for delta in self._deltas])
        return {**frames, **{f"{key}_is_pad": is_pad for key in frames}}

    def _chunks(self, actions: Tensor, n_slots: int) -> list[ActionChunk]:
        rows = actions.detach().to("cpu", torch.float32).numpy()
        expected = (n_slots, self.spec.chunk_size)
        if rows.shape[:2] != expected:
            raise InvalidActionError(
                f"policy '{self.spec.name}': expected chunks of shape {expected} before the action's "
                f"dimensions, found {rows.shape}. Its `action_delta_indices` and `predict_action_chunk` "
                "disagree."
            )
        return [ActionChunk(actions=np.ascontiguousarray(row)) for row in rows]


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
) -> LeRobotPolicy:
    """Make a policy from a LeRobot checkpoint; `docs/lerobot_policies.md` explains the arguments.

    Raises:
        CheckpointError: no checkpoint, or one that is not complete.
        SpecMismatchError: the policy and the environment do not fit.
    """
    if checkpoint is None:
        raise CheckpointError(
            f"policy '{context.name}' has no weights: its recipe says how to fine-tune it."
            f"{first_fetch(context.name)} Run `mikasa-vla finetune --policy {context.name} --dataset DIR "
            "--out RUN`, then `mikasa-vla eval --policy RUN`; or name a folder with `checkpoint` in the "
            "recipe's args."
        )
    options = LoadOptions(
        device=choose_device(device), dtype=dtype, tokenizer=tokenizer, base_checkpoint=base_checkpoint
    )
    loaded = load_checkpoint(Path(checkpoint), options)
    asked = InputOptions(
        cameras=default_cameras() if cameras is None else cameras, state=state, absent_cameras=absent_cameras
    )
    inputs = input_map(loaded.config, loaded.preprocessor, asked, context.env, policy=context.name)
    check_training(
        read_facts(loaded.folder),
        inputs,
        loaded.config,
        loaded.preprocessor,
        context.env,
        policy=context.name,
    )
    return LeRobotPolicy(context.name, loaded, inputs, batch=batch, n_slots=context.n_slots)


def choose_device(device: str) -> str:
    """Return the device that `auto` means here; anything else is left as it is.

    Raises:
        SpecMismatchError: a GPU is asked for that is not there.
    """
    has_cuda = torch.cuda.is_available()
    if device == "auto":
        return "cuda" if has_cuda else "cpu"
    if device.startswith("cuda") and not has_cuda:
        raise SpecMismatchError(
            f"device is '{device}', but torch finds no GPU here. Run `mikasa-vla doctor`, or use device: cpu."
        )
    return device


def _seed(slot: _Slot) -> int:
    """Return the seed of one inference of one episode; the same wherever and beside whatever it runs."""
    start = slot.start
    rng = generator(start.seed, Stream.POLICY, zlib.crc32(start.task.encode()), start.run, slot.step)
    return int(rng.integers(1 << N_SEED_BITS))


def _noise(seed: int, shape: tuple[int, int]) -> Tensor:
    # On the CPU: the same draws on every device.
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def _in_time(frames: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    return {key: torch.stack([frame[key] for frame in frames]) for key in frames[0]}


def _batched(frames: Sequence[Mapping[str, Tensor]], slots: Sequence[_Slot]) -> dict[str, Any]:
    batch: dict[str, Any] = {key: torch.stack([frame[key] for frame in frames]) for key in frames[0]}
    return {**batch, "task": [slot.start.instruction for slot in slots]}


def _cuda_devices(device: str) -> list[torch.device]:
    return [torch.device(device)] if str(device).startswith("cuda") else []


def _autocast(config: Any) -> AbstractContextManager[None]:
    if not config.use_amp:
        return nullcontext()
    context: AbstractContextManager[None] = torch.autocast(torch.device(config.device).type)
    return context
