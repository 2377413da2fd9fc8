"""A delayed cue on the fake simulator that can be seen: a bright square on the left or right of the image.

The arm has to go to that side. Demonstrations of it, trainings of a tiny policy on them, and its choices.
The square is gone before the arm may move. Then a bright bar says that it may: an image of the present says
when to go, but not where.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.core import EpisodeStart, FloatArray, ImageArray, StepResult
from vla_eval.data.facts import ImportFacts
from vla_eval.data.opening import LocalDataset, OpenDataset
from vla_eval.data.recording.shard_writer import new_dataset
from vla_eval.envs.fake import M_PER_STEP, FakeEnv
from vla_eval.features import CAMERA_KEYS, EncoderSettings, dataset_features, frame_values
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.training import job as job_module
from vla_eval.training.finetune import finetune

TASK, INSTRUCTION = "RememberColor3-v0", "touch it"
ARGUMENTS = {"n_items": 2, "cue_steps": 3, "delay_steps": 3, "horizon_steps": 20, "freeze_until_choice": True}
N_ACTION_STEPS = 2
SQUARE_PX, LIGHT, TABLE = 40, 250, 90
SIDE_M = 2.5 * M_PER_STEP  # three steps sideways choose


class SeenCueEnv(FakeEnv):
    """The fake simulator with a cue that can be seen, and candidates that are sides."""

    def _image(self, episode: Any, camera: str) -> ImageArray:
        size = self._image_size_px
        image = np.full((size, size, 3), TABLE, dtype=np.uint8)
        if self._is_in_view(episode):
            middle = size * 3 // 4 if _side(episode, episode.targets[0]) > 0 else size // 4
            rows, columns = (slice(at - SQUARE_PX // 2, at + SQUARE_PX // 2) for at in (size // 2, middle))
            image[rows, columns] = LIGHT
        elif episode.step >= self._response_step:
            image[:SQUARE_PX] = LIGHT
        return image

    def _touched(self, episode: Any) -> int | None:
        if episode.step < self._response_step or abs(episode.tcp_m[1]) < SIDE_M:
            return None
        sides = [_side(episode, candidate) for candidate in range(self._n_items)]
        return sides.index(np.sign(episode.tcp_m[1]))


def _side(episode: Any, candidate: int) -> float:
    return float(np.sign(episode.candidates_m[candidate, 1]))


def make_env() -> SeenCueEnv:
    """Make the environment; demonstrations need what only an expert may see."""
    cameras = tuple(CAMERA_KEYS)
    return SeenCueEnv(
        EnvSettings(task=TASK, kwargs=ARGUMENTS, simulator="fake", cameras=cameras, privileged=True)
    )


def write_demonstrations(root: Path, *, n_episodes: int) -> OpenDataset:
    """Write demonstrations of an expert that waits and then goes to the right side."""
    max_frames = ARGUMENTS["horizon_steps"]
    dataset = new_dataset(root, dataset_features("eef"), encoder=EncoderSettings(), max_frames=max_frames)
    for seed in range(1000, 1000 + n_episodes):
        for frame in _frames(seed):
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    facts = ImportFacts(
        complete=True,
        source_layout="adopted",
        task=TASK,
        instruction_source="source",
        state="eef",
        control_mode="pd_ee_delta_pose",
        executable_by_pd_ee_delta_pose=True,
        absent=(),
        left_out=(),
        n_frames=1,
        episodes=(),
        source_files={},
        files={},
        vla_eval_version="0",
    )
    local = LocalDataset(root)
    return OpenDataset(root=root, facts=facts, manifest=(), failed_seeds=(), replay=None, local=local)


def _frames(seed: int) -> Iterator[dict[str, Any]]:
    env = make_env()
    before = env.reset({0: seed}, render=True)[0]
    n_after = 0  # two frames after the success, too
    while n_after < 3:
        action = _expert(env, before)
        after = env.step({0: action}, render=frozenset({0}))[0]
        n_after += after.status.success
        values = frame_values(before, after, action=action, state="eef", is_last=n_after == 3)
        yield {**values, "task": INSTRUCTION}
        before = after


def _expert(env: SeenCueEnv, result: StepResult) -> FloatArray:
    state = result.observation.privileged
    action = env.hold_action(0)
    if state is not None and state.target is not None and result.status.phase == "response":
        action[1] = np.sign(state.candidate_positions_m[state.target, 1])
    return action


def trained(
    dataset: OpenDataset, recipe: Path, out: Path, monkeypatch: pytest.MonkeyPatch, **section: Any
) -> Path:
    """Train with this `finetune` section, and return the run's folder."""
    monkeypatch.setattr(job_module, "training_dataset", lambda *_, **__: dataset)
    config = FinetuneConfig(
        policy=str(recipe), dataset=str(dataset.root), out=str(out), device="cpu", finetune=section
    )
    finetune(config)
    return out


def choices(run: Path, *, n_episodes: int) -> list[bool | None]:
    """Return of each new episode whether the trained policy went to the right side; None: to neither."""
    env = make_env()
    chunking = ChunkingSpec(n_action_steps=N_ACTION_STEPS)
    policy = make_lerobot(
        PolicyContext(name="p", env=env.spec, chunking=chunking, n_candidates=2), checkpoint=str(run)
    )
    chosen = []
    for seed in range(1, 1 + n_episodes):
        start = EpisodeStart(
            slot=0,
            task=TASK,
            seed=seed,
            run=0,
            instruction=INSTRUCTION,
            horizon_steps=ARGUMENTS["horizon_steps"],
        )
        (record,) = rollout(env, policy, [start], RolloutSettings(chunking=chunking))
        assert record.error is None
        chosen.append(None if record.first_choice is None else record.first_choice_success)
    return chosen
