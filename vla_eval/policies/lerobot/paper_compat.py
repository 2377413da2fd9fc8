"""What the paper's public OpenVLA evaluation does otherwise, each by its name, so that it can be measured.

The switches act around a trained policy: its weights, prompt and normalisation stay as they are.

- `gripper_sign`: the predicted gripper g is executed as -sign(2 g - 1), so that +1 (open) closes.
- `last_k_queue`: of a chunk longer than `n_action_steps` the **last** actions are executed.
- `jpeg`: images go through JPEG at quality 95, which those of the training did not. PIL's encoder
  stands for TensorFlow's; on a harsh image the two differ by up to 19 of 255 levels.

Source: https://github.com/CognitiveAISystems/MIKASA-Robo, branch `openvla` at commit 528086e,
experiments/robot/mikasa/run_mikasa_eval.py lines 253-263 and 299-331, experiments/robot/openvla_utils.py
line 538. That these runs made the paper's table is not known.
"""

import dataclasses
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from PIL import Image

from vla_eval.core import ActionChunk, EpisodeStart, ImageArray, Observation, ObservationWindow
from vla_eval.errors import RecipeError, check_names
from vla_eval.models.shared.gripper import Gripper
from vla_eval.policies.compiled import Compilation
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.specs import EnvSpec

SWITCHES = ("gripper_sign", "last_k_queue", "jpeg")
JPEG_QUALITY = 95  # TensorFlow's default, which the original leaves as it is


class PaperCompatPolicy:
    """A policy with some of the switches on; see the module's text."""

    def __init__(self, policy: LeRobotPolicy, switches: Sequence[str], *, n_action_steps: int) -> None:
        self._policy, self._switches = policy, frozenset(switches)
        self._n_last = n_action_steps if "last_k_queue" in self._switches else policy.spec.chunk_size
        self._gripper = Gripper(decoding="paper_openvla")
        self.spec = dataclasses.replace(policy.spec, chunk_size=self._n_last)

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin these episodes."""
        self._policy.reset(episodes)

    def warm_up(self, env: EnvSpec, sentences: Sequence[str]) -> Compilation | None:
        """Compile the network, if that was asked for; see `LeRobotPolicy.warm_up`."""
        return self._policy.warm_up(env, sentences)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Decide for one episode."""
        return self.act_batch([window])[0]

    def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        """Decide for each window."""
        shown = [self._shown(window) for window in windows] if "jpeg" in self._switches else windows
        return [self._changed(chunk) for chunk in self._policy.act_batch(shown)]

    def _shown(self, window: ObservationWindow) -> ObservationWindow:
        return dataclasses.replace(window, frames=tuple(_compressed(frame) for frame in window.frames))

    def _changed(self, chunk: ActionChunk) -> ActionChunk:
        actions = chunk.actions[-self._n_last :]
        if "gripper_sign" in self._switches:
            actions = self._gripper.decode(torch.from_numpy(actions)).numpy()
        return ActionChunk(actions=np.ascontiguousarray(actions))


def make_paper_compat(
    context: PolicyContext,
    *,
    paper_compat: Sequence[str] = (),
    **args: Any,  # Any: those of `make_lerobot`
) -> LeRobotPolicy | PaperCompatPolicy:
    """Make a policy from a checkpoint, with some `SWITCHES`; `args` are those of the adapter `lerobot`."""
    check_names("switch", paper_compat, SWITCHES, where="args.paper_compat")
    policy = make_lerobot(context, **args)
    n_action_steps = context.chunking.n_action_steps
    if "last_k_queue" in paper_compat and context.chunking.min_chunk_size != n_action_steps:
        raise RecipeError("paper_compat last_k_queue goes with no delay: the original knows of none.")
    context.chunking.check_chunk_size(policy.spec.chunk_size, policy=context.name)
    if not paper_compat:
        return policy
    return PaperCompatPolicy(policy, paper_compat, n_action_steps=n_action_steps)


def _compressed(frame: Observation) -> Observation:
    images = {camera: jpeg_round_trip(image) for camera, image in frame.images.items()}
    return dataclasses.replace(frame, images=images)


def jpeg_round_trip(image: ImageArray) -> ImageArray:
    """Return an image (H, W, 3) uint8 as JPEG leaves it."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="JPEG", quality=JPEG_QUALITY)
    with Image.open(io.BytesIO(buffer.getvalue())) as decoded:
        return np.array(decoded.convert("RGB"))
