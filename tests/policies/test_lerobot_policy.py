"""LeRobot policies in our loop: nothing hides frames, nothing depends on neighbours."""

import dataclasses
import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.checkpoints import small_checkpoints
from tests.checkpoints.small_checkpoints import (
    FAKE,
    context_for,
    observation,
    save,
    start,
    window,
    with_features,
)
from vla_eval.chunking import ChunkingSpec
from vla_eval.core import Observation
from vla_eval.envs.factory import make_env
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import EnvSpec
from vla_eval.testing import check_policy
from vla_eval.testing.tiny_models import make_tiny

pytestmark = pytest.mark.usefixtures("no_network")
backbone, env = small_checkpoints.backbone, small_checkpoints.env
act, pi0, make = small_checkpoints.act, small_checkpoints.pi0, small_checkpoints.make
diffusion = small_checkpoints.diffusion

BATCH_TOLERANCE = 1e-5  # float32, sums of some hundred terms in another order


def _count_passes(policy: Any) -> list[int]:
    """Return a list that gets the number of rows of each forward pass."""
    rows: list[int] = []
    predict = policy._loaded.policy.predict_action_chunk

    def counting(batch: dict[str, Any], **extra: Any) -> Any:
        rows.append(len(batch["observation.state"]))
        return predict(batch, **extra)

    policy._loaded.policy.predict_action_chunk = counting
    return rows


class TestContract:
    def test_a_policy_passes_the_kit_bit_for_bit(self, make: Any, env: EnvSpec) -> None:
        check_policy(make, env)

    def test_one_pass_for_all_slots_gives_the_actions_of_separate_ones(self, make: Any) -> None:
        one_by_one, together = make(), make(batch=True)
        episodes = [start(slot, seed=slot + 1) for slot in range(3)]
        windows = [window(slot, observation(level=60 * slot)) for slot in range(3)]
        answers = []
        for policy in (one_by_one, together):
            policy.reset(episodes)
            answers.append(np.stack([chunk.actions for chunk in policy.act_batch(windows)]))
        assert np.abs(answers[0][0] - answers[0][1]).max() > 1e-3  # the slots do differ
        np.testing.assert_allclose(answers[1], answers[0], atol=BATCH_TOLERANCE)

    @pytest.mark.parametrize("family", ["act", "pi0", "diffusion"])
    def test_in_one_pass_an_episodes_bits_are_its_own_whoever_is_beside_it(
        self, request: pytest.FixtureRequest, env: EnvSpec, family: str
    ) -> None:
        maker: Any = make_tiny if family == "pi0" else make_lerobot
        checkpoint = str(request.getfixturevalue(family))
        policy = maker(dataclasses.replace(context_for(env), n_slots=3), checkpoint=checkpoint)
        passes = _count_passes(policy)

        def actions(*rows: int) -> dict[int, Any]:
            policy.reset([start(40 - 9 * row, seed=row + 1, row=row) for row in rows])
            windows = [window(40 - 9 * row, observation(level=60 * row)) for row in rows]
            return {row: chunk.actions for row, chunk in zip(rows, policy.act_batch(windows), strict=True)}

        together, some, one = actions(0, 1, 2), actions(2, 0), actions(1)
        assert passes == [3, 3, 3]  # rows of each pass
        assert [together[row].tobytes() for row in (2, 0)] == [some[row].tobytes() for row in (2, 0)]
        assert together[1].tobytes() == one[1].tobytes()
        alone = maker(context_for(env), checkpoint=checkpoint)
        alone.reset([start(1, seed=2)])
        expected = alone.act(window(1, observation(level=60))).actions
        np.testing.assert_allclose(together[1], expected, atol=BATCH_TOLERANCE)

    def test_it_runs_through_the_loop_with_fewer_actions_than_its_chunk(self, make: Any) -> None:
        fake = make_env(FAKE)
        settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=3))
        (record,) = rollout(fake, make(), [dataclasses.replace(start(), horizon_steps=9)], settings)
        assert record.n_inferences == 3  # 9 steps, 3 actions each

    def test_the_noise_is_the_episodes_own(self, pi0: Path, env: EnvSpec) -> None:
        policy = make_tiny(context_for(env), checkpoint=str(pi0))

        def actions(seed: int, run: int, step: int) -> bytes:
            policy.reset([start(seed=seed, run=run)])
            return policy.act(window(0, observation(step=step))).actions.tobytes()

        torch.manual_seed(123)  # global state must not matter
        once = actions(1, 0, 0)
        torch.manual_seed(456)
        assert actions(1, 0, 0) == once
        assert len({once, actions(2, 0, 0), actions(1, 1, 0), actions(1, 0, 4)}) == 4

    def test_drawing_leaves_the_global_generator_alone(self, pi0: Path, env: EnvSpec) -> None:
        policy = make_tiny(context_for(env), checkpoint=str(pi0))
        policy.reset([start()])
        torch.manual_seed(7)
        expected = torch.rand(1)
        torch.manual_seed(7)
        policy.act(window())
        assert torch.equal(torch.rand(1), expected)


CONFIGURATION = """
from dataclasses import dataclass, field
from lerobot.configs import NormalizationMode, PreTrainedConfig


@PreTrainedConfig.register_subclass("counter")
@dataclass
class CounterConfig(PreTrainedConfig):
    chunk_size: int = 4
    deltas: list[int] | None = None
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {k: NormalizationMode.IDENTITY for k in ("VISUAL", "STATE", "ACTION")}
    )

    def validate_features(self): ...
    def get_optimizer_preset(self): ...
    def get_scheduler_preset(self): ...
    observation_delta_indices = property(lambda self: self.deltas)
    action_delta_indices = property(lambda self: list(range(self.chunk_size)))
    reward_delta_indices = property(lambda self: None)
"""
MODELING = """
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from .configuration_counter import CounterConfig


class CounterPolicy(PreTrainedPolicy):
    '''Answers with what it has seen: how many frames (or, without memory, how bright each one was).'''
    config_class, name = CounterConfig, "counter"

    def __init__(self, config, **kwargs):
        super().__init__(config)
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def get_optim_params(self): return self.parameters()
    def reset(self): ...
    def forward(self, batch): ...
    def select_action(self, batch): raise AssertionError("its own queue would hide frames")

    def predict_action_chunk(self, batch, memory=None):
        actions = torch.zeros(len(batch["task"]), self.config.chunk_size, 7)
        if memory is not None:
            actions[:, :, 0] = memory
        else:
            levels = batch["observation.images.base"].mean(dim=(-3, -2, -1))
            actions[:, 0, : levels.shape[1]] = levels
        return actions
"""
REMEMBERING = """
    def remember(self, batch, memory):
        assert batch["observation.images.base"].shape[2:] == (3, 128, 128)
        return (memory or 0) + batch["observation.images.base"].shape[1]
"""
PROCESSOR = """
from lerobot.processor import make_default_policy_processor_steps, make_policy_processor_pipelines


def make_counter_pre_post_processors(config, dataset_stats=None):
    s = make_default_policy_processor_steps(config, dataset_stats)
    return make_policy_processor_pipelines(
        input_steps=[s.rename_observations, s.add_batch_dim, s.to_device, s.normalize],
        output_steps=[s.unnormalize, s.to_cpu],
    )
"""


@pytest.fixture(scope="module")
def counter_config(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A plugin policy as a user would install it: a package of three modules."""
    root = tmp_path_factory.mktemp("plugin")
    package = root / "lerobot_policy_counter"
    package.mkdir()
    (package / "__init__.py").write_text("from .configuration_counter import CounterConfig\n")
    (package / "configuration_counter.py").write_text(CONFIGURATION)
    (package / "modeling_counter.py").write_text(MODELING)
    (package / "processor_counter.py").write_text(PROCESSOR)
    sys.path.insert(0, str(root))
    yield importlib.import_module("lerobot_policy_counter").CounterConfig
    sys.path.remove(str(root))


class TestFramesOfAPluginPolicy:
    def make(self, counter_config: Any, folder: Path, env: EnvSpec, **fields: Any) -> LeRobotPolicy:
        config = with_features(counter_config(device="cpu", push_to_hub=False, **fields))
        save(config, folder)
        return make_lerobot(context_for(env), checkpoint=str(folder))

    @pytest.fixture
    def remembering(
        self, counter_config: Any, tmp_path: Path, env: EnvSpec, monkeypatch: pytest.MonkeyPatch
    ) -> LeRobotPolicy:
        modeling: Any = importlib.import_module("lerobot_policy_counter.modeling_counter")
        scope: dict[str, Any] = {}
        exec("if True:" + REMEMBERING, scope)
        monkeypatch.setattr(modeling.CounterPolicy, "remember", scope["remember"], raising=False)
        return self.make(counter_config, tmp_path / "m", env)

    def test_a_policy_with_memory_sees_every_frame_whatever_the_chunk(
        self, remembering: LeRobotPolicy
    ) -> None:
        seen: list[float] = []

        class Watch:
            def wants_images(self, step: int) -> bool:
                return False

            def on_reset(self, *args: Any) -> None: ...
            def on_step(self, *args: Any) -> None: ...
            def on_inference(self, episode: Any, step: int, chunk: Any) -> None:
                seen.append(float(chunk.actions[0, 0]))

        settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=4))
        episode = dataclasses.replace(start(), horizon_steps=10)
        rollout(make_env(FAKE), remembering, [episode], settings, observers=[Watch()])
        assert seen == [1, 5, 9]  # at steps 0, 4, 8: the frames 0 … step

    def test_memory_begins_anew_with_each_episode_and_is_each_slots_own(
        self, remembering: LeRobotPolicy
    ) -> None:
        def count(slot: int, n_frames: int) -> float:
            frames = [observation(step) for step in range(n_frames)]
            return float(remembering.act(window(slot, *frames)).actions[0, 0])

        remembering.reset([start(0), start(1)])
        assert (count(0, 3), count(1, 1), count(0, 2)) == (3, 1, 5)
        remembering.reset([start(0)])
        assert (count(0, 1), count(1, 1)) == (1, 2)

    def test_a_history_holds_the_frames_that_training_had(
        self, counter_config: Any, tmp_path: Path, env: EnvSpec
    ) -> None:
        policy = self.make(counter_config, tmp_path / "m", env, deltas=[-2, -1, 0])
        assert policy.spec.reads == "every"
        policy.reset([start()])

        def levels(*frames: Observation) -> list[int]:
            row = policy.act(window(0, *frames)).actions[0, :3]
            return [round(float(value) * 255) for value in row]

        assert levels(observation(0, 10)) == [10, 10, 10]  # before the first frame: the first frame
        assert levels(observation(1, 20)) == [10, 10, 20]
        assert levels(*(observation(2 + i, 30 + 10 * i) for i in range(4))) == [40, 50, 60]
        policy.reset([start()])
        assert levels(observation(0, 70)) == [70, 70, 70]

    @pytest.mark.parametrize(("deltas", "n_times"), [(None, 0), ([0], 1), ([0, 4, 8], 0)])
    def test_a_single_frame_has_the_axes_that_training_gave_it(
        self,
        counter_config: Any,
        tmp_path: Path,
        env: EnvSpec,
        deltas: list[int] | None,
        n_times: int,
    ) -> None:
        """lerobot's datasets give (B, 1, …) for `[0]` and (B, …) for None; frames to come are targets."""
        policy = self.make(counter_config, tmp_path / "m", env, deltas=deltas)
        shapes: list[tuple[int, ...]] = []

        def watched(batch: dict[str, Any], **extra: Any) -> torch.Tensor:
            shapes.append(tuple(batch["observation.images.base"].shape))
            return torch.zeros(1, 4, 7)

        policy._loaded.policy.predict_action_chunk = watched
        policy.reset([start()])
        policy.act(window(0, observation(0, 10)))
        assert shapes == [(1, *([1] * n_times), 3, 128, 128)]
        assert policy.spec.reads == "last"
