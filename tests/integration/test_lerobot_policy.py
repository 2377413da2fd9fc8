"""LeRobot policies in our loop: nothing loads half, nothing hides frames, nothing depends on neighbours."""

import contextlib
import dataclasses
import importlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from safetensors.torch import load_file, save_file

from vla_eval import evaluate as evaluate_module
from vla_eval.cli.main import main
from vla_eval.core import EpisodeStart, Observation, ObservationWindow
from vla_eval.data.features import proprioception
from vla_eval.envs.factory import make_env
from vla_eval.envs.settings import EnvSettings
from vla_eval.errors import CheckpointError, SpecMismatchError
from vla_eval.policies.checkpoint import (
    TrainingFacts,
    checkpoint_name,
    checkpoint_sha256,
    find_checkpoint,
    write_facts,
)
from vla_eval.policies.chunking import ChunkingSpec
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot import LeRobotPolicy, make_lerobot
from vla_eval.policies.lerobot_loading import LoadOptions, load_weights, make_empty_policy, read_config
from vla_eval.results.store import read_run
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import EnvSpec
from vla_eval.testing import check_policy
from vla_eval.training.tiny_models import (
    TINY_POLICY,
    make_tiny_pi0,
    tiny_paligemma,
    tiny_resnet,
    tiny_worker_main,
    write_tiny_tokenizer,
)

pytestmark = pytest.mark.usefixtures("no_network")

TASK = "RememberColor3-v0"
FAKE = EnvSettings(task=TASK, simulator="fake", cameras=("base_camera", "hand_camera"))
BATCH_TOLERANCE = 1e-5  # float32, sums of some hundred terms in another order
STATISTICS_SHAPES = {
    "observation.images.base": (3, 1, 1),
    "observation.images.wrist": (3, 1, 1),
    "observation.state": (10,),
    "action": (7,),
}


@pytest.fixture(scope="module")
def env() -> EnvSpec:
    spec: EnvSpec = make_env(FAKE).spec
    return spec


def context_for(env: EnvSpec) -> PolicyContext:
    return PolicyContext(name="p", env=env, chunking=ChunkingSpec(n_action_steps=4), n_candidates=3)


def with_features(config: Any, n_state: int = 10, image: tuple[int, int, int] = (3, 128, 128)) -> Any:
    config.input_features = {
        "observation.images.base": PolicyFeature(FeatureType.VISUAL, image),
        "observation.images.wrist": PolicyFeature(FeatureType.VISUAL, image),
        "observation.state": PolicyFeature(FeatureType.STATE, (n_state,)),
    }
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
    return config


def statistics(n_state: int = 10) -> dict[str, dict[str, Any]]:
    rng = np.random.default_rng(0)
    shapes = {**STATISTICS_SHAPES, "observation.state": (n_state,)}
    names = ("mean", "std", "min", "max", "q01", "q99")
    return {key: {name: rng.uniform(0.5, 0.9, shape) for name in names} for key, shape in shapes.items()}


def save(config: Any, folder: Path, n_state: int = 10, preprocessors: Any = None) -> Path:
    torch.manual_seed(0)
    make_empty_policy(config).save_pretrained(folder)
    for pipeline in make_pre_post_processors(config, dataset_stats=statistics(n_state)):
        pipeline.save_pretrained(folder)
    return folder


def act_config() -> ACTConfig:
    return ACTConfig(
        device="cpu",
        chunk_size=8,
        n_action_steps=8,
        pretrained_backbone_weights=None,
        push_to_hub=False,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        latent_dim=8,
    )


@pytest.fixture(scope="module", autouse=True, params=["small", pytest.param("real", marks=pytest.mark.slow)])
def eyes(request: pytest.FixtureRequest) -> Iterator[str]:
    """ACT's ResNet-18, or one convolution in its place."""
    with tiny_resnet() if request.param == "small" else contextlib.nullcontext():
        yield request.param


@pytest.fixture(scope="module")
def act(eyes: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(with_features(act_config()), tmp_path_factory.mktemp("act") / "model")


@pytest.fixture(scope="module")
def pi0(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pi0")
    tokenizer = write_tiny_tokenizer(folder / "model" / "tokenizer")
    fields = {**TINY_POLICY, "image_resolution": (56, 56)}
    config = with_features(PI0Config(device="cpu", push_to_hub=False, **fields))
    processing: Any = importlib.import_module("lerobot.policies.pi0.processor_pi0")
    step = processing.TokenizerProcessorStep
    with pytest.MonkeyPatch.context() as patch, tiny_paligemma():
        # Where a full run has the gated tokenizer in the cache, a test has a folder.
        patch.setattr(
            processing,
            "TokenizerProcessorStep",
            lambda **fields: step(**{**fields, "tokenizer_name": str(tokenizer)}),
        )
        return save(config, folder / "model")


@pytest.fixture(params=["act", "pi0"])
def make(request: pytest.FixtureRequest, env: EnvSpec) -> Callable[..., LeRobotPolicy]:
    folder = request.getfixturevalue(request.param)
    maker: Any = make_lerobot if request.param == "act" else make_tiny_pi0
    return lambda **args: maker(context_for(env), **{"checkpoint": str(folder), **args})


def start(slot: int = 0, seed: int = 1, run: int = 0) -> EpisodeStart:
    return EpisodeStart(slot=slot, task=TASK, seed=seed, run=run, instruction="touch it", horizon_steps=60)


def observation(step: int = 0, level: int = 100) -> Observation:
    picture = np.full((128, 128, 3), level, dtype=np.uint8)
    pose = np.array([0, 0, 0.2, 0, 1, 0, 0], dtype=np.float32)
    return Observation(
        step=step,
        images={"base_camera": picture, "hand_camera": picture},
        state={"tcp_pose": pose, "qpos": np.zeros(9, np.float32), "qvel": np.zeros(9, np.float32)},
    )


def window(slot: int = 0, *frames: Observation) -> ObservationWindow:
    return ObservationWindow(slot=slot, frames=frames or (observation(),))


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

    @pytest.mark.parametrize("family", ["act", "pi0"])
    def test_in_one_pass_an_episodes_bits_are_its_own_whoever_is_beside_it(
        self, request: pytest.FixtureRequest, env: EnvSpec, family: str
    ) -> None:
        maker: Any = make_lerobot if family == "act" else make_tiny_pi0
        checkpoint = str(request.getfixturevalue(family))
        policy = maker(dataclasses.replace(context_for(env), n_slots=3), checkpoint=checkpoint)
        passes = _count_passes(policy)

        def actions(*slots: int) -> dict[int, Any]:
            policy.reset([start(slot, seed=slot + 1) for slot in slots])
            windows = [window(slot, observation(level=60 * slot)) for slot in slots]
            return {slot: chunk.actions for slot, chunk in zip(slots, policy.act_batch(windows), strict=True)}

        together, some, one = actions(0, 1, 2), actions(2, 0), actions(1)
        assert passes == [3, 3, 3]  # rows of each pass
        assert [together[slot].tobytes() for slot in (2, 0)] == [some[slot].tobytes() for slot in (2, 0)]
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
        policy = make_tiny_pi0(context_for(env), checkpoint=str(pi0))

        def actions(seed: int, run: int, step: int) -> bytes:
            policy.reset([start(seed=seed, run=run)])
            return policy.act(window(0, observation(step=step))).actions.tobytes()

        torch.manual_seed(123)  # global state must not matter
        once = actions(1, 0, 0)
        torch.manual_seed(456)
        assert actions(1, 0, 0) == once
        assert len({once, actions(2, 0, 0), actions(1, 1, 0), actions(1, 0, 4)}) == 4

    def test_drawing_leaves_the_global_generator_alone(self, pi0: Path, env: EnvSpec) -> None:
        policy = make_tiny_pi0(context_for(env), checkpoint=str(pi0))
        policy.reset([start()])
        torch.manual_seed(7)
        expected = torch.rand(1)
        torch.manual_seed(7)
        policy.act(window())
        assert torch.equal(torch.rand(1), expected)


class TestStrictLoading:
    @pytest.fixture
    def broken(self, request: pytest.FixtureRequest, make: Any, tmp_path: Path) -> Callable[..., Any]:
        """Return a function that edits a copy of the checkpoint's tensors and loads it."""
        name = request.node.callspec.params["make"]
        source: Path = request.getfixturevalue(name)

        def load(edit: Callable[[dict[str, torch.Tensor]], None]) -> LeRobotPolicy:
            for file in source.iterdir():
                if file.is_file():
                    (tmp_path / file.name).write_bytes(file.read_bytes())
            weights = load_file(source / "model.safetensors")
            edit(weights)
            save_file(weights, tmp_path / "model.safetensors")
            tokenizer = {"tokenizer": str(source / "tokenizer")} if name == "pi0" else {}
            policy: LeRobotPolicy = make(checkpoint=str(tmp_path), **tokenizer)
            return policy

        return load

    def test_an_unchanged_copy_loads(self, broken: Any) -> None:
        assert broken(lambda weights: None).spec.chunk_size > 0

    def test_a_missing_tensor_is_an_error_that_names_it(self, broken: Any) -> None:
        victim: list[str] = []

        def edit(weights: dict[str, torch.Tensor]) -> None:
            victim.append(sorted(weights)[3])
            del weights[victim[0]]

        with pytest.raises(CheckpointError) as caught:
            broken(edit)
        assert f"1 missing: {victim[0]}" in str(caught.value)

    def test_a_tensor_of_another_model_is_an_error(self, broken: Any) -> None:
        with pytest.raises(CheckpointError, match=r"1 unexpected: model\.stranger"):
            broken(lambda weights: weights.update({"model.stranger": torch.zeros(2)}))

    def test_another_shape_is_an_error_with_both_shapes(self, broken: Any) -> None:
        def edit(weights: dict[str, torch.Tensor]) -> None:
            key = next(k for k, v in weights.items() if v.ndim == 2)
            weights[key] = weights[key][:-1].clone()

        with pytest.raises(CheckpointError, match=r"1 of another shape: .*\(expected \(\d+, \d+\), found"):
            broken(edit)

    def test_another_precision_is_an_error(self, broken: Any) -> None:
        def edit(weights: dict[str, torch.Tensor]) -> None:
            key = next(k for k, v in weights.items() if v.ndim == 2)
            weights[key] = weights[key].to(torch.bfloat16)

        with pytest.raises(CheckpointError, match=r"expected torch.float32, found torch.bfloat16"):
            broken(edit)

    def test_a_weight_that_is_no_number_is_an_error(self, broken: Any) -> None:
        def edit(weights: dict[str, torch.Tensor]) -> None:
            key = next(k for k, v in weights.items() if v.ndim == 2)
            weights[key][0, 0] = float("nan")

        with pytest.raises(CheckpointError, match=r"not finite"):
            broken(edit)

    def test_a_checkpoint_without_weights_is_an_error(self, act: Path, tmp_path: Path, env: EnvSpec) -> None:
        (tmp_path / "config.json").write_text((act / "config.json").read_text())
        (tmp_path / "pytorch_model.bin").write_bytes(b"\x80\x04.")
        with pytest.raises(CheckpointError, match=r"never loaded: convert them to safetensors"):
            make_lerobot(context_for(env), checkpoint=str(tmp_path))

    def test_the_stock_loader_would_have_gone_on_with_random_weights(
        self, pi0: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """If this fails, lerobot was mended: the reason for a loader of our own may be gone."""
        from lerobot.policies.pi0.modeling_pi0 import PI0Policy

        config = read_config(pi0, LoadOptions(device="cpu"))
        with tiny_paligemma():
            loaded = load_weights(pi0, config, LoadOptions(device="cpu"))
            random = PI0Policy.from_pretrained(tmp_path / "nothing", config=config)
        assert "Returning model without loading pretrained weights" in capsys.readouterr().out
        key = "model.action_out_proj.weight"
        assert not torch.equal(random.state_dict()[key], loaded.state_dict()[key])


def copied(source: Path, target: Path) -> Path:
    for file in source.iterdir():
        (target / file.name).write_bytes(file.read_bytes())
    return target


class TestProcessors:
    def test_missing_statistics_are_an_error_that_names_them(
        self, act: Path, tmp_path: Path, env: EnvSpec
    ) -> None:
        folder = copied(act, tmp_path)
        (state,) = folder.glob("policy_postprocessor_step_*.safetensors")
        tensors = {k: v for k, v in load_file(state).items() if not k.startswith("action.")}
        save_file(tensors, state)
        with pytest.raises(CheckpointError, match=r"no statistics for action\.mean, action\.std"):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_code_that_is_no_processor_is_not_run(self, act: Path, tmp_path: Path, env: EnvSpec) -> None:
        folder = copied(act, tmp_path)
        file = folder / "policy_preprocessor.json"
        data = json.loads(file.read_text())
        data["steps"].append({"class": "os.system", "config": {"command": "true"}})
        file.write_text(json.dumps(data))
        with pytest.raises(CheckpointError, match=r"names the code 'os\.system'"):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_a_missing_tokenizer_is_an_error_that_says_what_to_name(
        self, pi0: Path, tmp_path: Path, env: EnvSpec
    ) -> None:
        for file in pi0.iterdir():
            if file.is_file():
                (tmp_path / file.name).write_bytes(file.read_bytes())
        file = tmp_path / "policy_preprocessor.json"
        file.write_text(file.read_text().replace(str(pi0 / "tokenizer"), "google/paligemma-3b-pt-224"))
        with pytest.raises(CheckpointError, match=r"Name a local folder with `tokenizer`"):
            make_tiny_pi0(context_for(env), checkpoint=str(tmp_path))


FACTS = TrainingFacts(
    run="r",
    dataset="RememberColor3-v0",
    dataset_sha256="d" * 64,
    task=TASK,
    state="eef",
    images={"observation.images.base": (128, 128), "observation.images.wrist": (128, 128)},
    fps=20.0,
    action_names=("dx", "dy", "dz", "drx", "dry", "drz", "gripper"),
    control_mode="pd_ee_delta_pose",
    run_seed=0,
)


class TestTrainingAgainstEvaluation:
    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"fps": 10.0}, r"control steps per second: expected 10\.0, found 20\.0"),
            ({"state": "joints"}, r"state: expected joints, found eef"),
            (
                {"control_mode": "pd_joint_pos"},
                r"control mode: expected pd_joint_pos, found pd_ee_delta_pose",
            ),
            ({"action_names": ("gripper", *FACTS.action_names[:-1])}, r"action dimensions: expected"),
            (
                {"images": dict(reversed(list(FACTS.images.items())))},
                r"images and their order: expected \('observation.images.wrist'",
            ),
            (
                {"images": {key: (256, 256) for key in FACTS.images}},
                r"size of observation.images.base: expected \(256, 256\), found \(128, 128\)",
            ),
        ],
    )
    def test_what_differs_is_named_with_both_values(
        self, act: Path, tmp_path: Path, env: EnvSpec, change: dict[str, Any], said: str
    ) -> None:
        folder = copied(act, tmp_path)
        write_facts(folder, dataclasses.replace(FACTS, **change))
        with pytest.raises(SpecMismatchError, match=said):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_the_same_is_accepted(self, act: Path, tmp_path: Path, env: EnvSpec) -> None:
        folder = copied(act, tmp_path)
        write_facts(folder, FACTS)
        assert make_lerobot(context_for(env), checkpoint=str(folder)).spec.chunk_size == 8

    def test_without_facts_the_size_of_the_pictures_is_still_compared(
        self, tmp_path: Path, env: EnvSpec
    ) -> None:
        folder = save(with_features(act_config(), image=(3, 96, 96)), tmp_path / "m")
        with pytest.raises(SpecMismatchError, match=r"expected \(96, 96\), found \(128, 128\)"):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_pictures_that_were_not_scaled_to_one_are_noticed(
        self, act: Path, tmp_path: Path, env: EnvSpec
    ) -> None:
        folder = copied(act, tmp_path)
        (state,) = folder.glob("policy_preprocessor_step_*normalizer*.safetensors")
        tensors = load_file(state)
        tensors["observation.images.base.mean"] = torch.full((3, 1, 1), 121.0)
        save_file(tensors, state)
        with pytest.raises(
            SpecMismatchError, match=r"expected statistics in \[0, 1\], found values up to 121"
        ):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_a_camera_that_is_not_mapped_is_an_error_and_no_black_picture(
        self, act: Path, env: EnvSpec
    ) -> None:
        with pytest.raises(SpecMismatchError, match=r"expects the image 'observation.images.wrist', found"):
            make_lerobot(
                context_for(env), checkpoint=str(act), cameras={"base_camera": "observation.images.base"}
            )

    def test_act_masks_no_cameras_so_none_may_be_absent(self, act: Path, env: EnvSpec) -> None:
        with pytest.raises(SpecMismatchError, match=r"does not mask missing cameras"):
            make_lerobot(context_for(env), checkpoint=str(act), absent_cameras=("observation.images.wrist",))

    def test_a_state_of_unknown_size_is_an_error_that_lists_the_kinds(
        self, tmp_path: Path, env: EnvSpec
    ) -> None:
        folder = save(with_features(act_config(), n_state=9), tmp_path / "m", n_state=9)
        with pytest.raises(SpecMismatchError, match=r"state of 9 dimensions.*eef \(10\), joints \(25\)"):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_the_state_is_computed_as_in_recording(self, tmp_path: Path, env: EnvSpec) -> None:
        folder = save(with_features(act_config(), n_state=25), tmp_path / "m", n_state=25)
        policy = make_lerobot(context_for(env), checkpoint=str(folder))
        seen = policy._inputs.tensors(observation())
        expected = proprioception(observation().state)["joints"]
        assert seen["observation.state"].numpy().tobytes() == expected.tobytes()
        assert seen["observation.images.base"].shape == (3, 128, 128)
        assert float(seen["observation.images.base"].max()) == pytest.approx(100 / 255)

    def test_a_chunk_shorter_than_n_action_steps_is_an_error(self, act: Path, env: EnvSpec) -> None:
        policy = make_lerobot(context_for(env), checkpoint=str(act))
        settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=9))
        with pytest.raises(SpecMismatchError, match=r"chunks of 8 actions, but n_action_steps=9"):
            rollout(make_env(FAKE), policy, [start()], settings)


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


class TestFolders:
    def test_a_run_a_checkpoint_and_its_model_folder_are_the_same_policy(
        self, act: Path, tmp_path: Path
    ) -> None:
        model = tmp_path / "myrun/train/checkpoints/000300/pretrained_model"
        model.mkdir(parents=True)
        copied(act, model)
        (tmp_path / "myrun/train/checkpoints/last").symlink_to("000300")
        named = [tmp_path / "myrun", model.parent, model]
        assert {find_checkpoint(path).resolve() for path in named} == {model.resolve()}
        assert {checkpoint_name(path) for path in named} == {"myrun-000300"}
        assert len({checkpoint_sha256(path) for path in named}) == 1

    def test_one_changed_byte_changes_the_digest(self, act: Path, tmp_path: Path) -> None:
        folder = copied(act, tmp_path)
        before = checkpoint_sha256(folder)
        data = bytearray((folder / "model.safetensors").read_bytes())
        data[-1] ^= 1
        (folder / "model.safetensors").write_bytes(data)
        assert checkpoint_sha256(folder) != before

    def test_eval_takes_a_folder_and_notes_weights_and_dataset(
        self, act: Path, eyes: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        if eyes == "small":
            monkeypatch.setattr(evaluate_module, "worker_main", tiny_worker_main)
        folder = tmp_path / "mine"
        folder.mkdir()
        copied(act, folder)
        write_facts(folder, FACTS)
        monkeypatch.setenv("OMP_NUM_THREADS", "1")
        arguments = ["--task", TASK, "--policy", str(folder), "--episodes", "2", "--workers", "1"]
        settings = [
            "--set",
            "simulator=fake",
            "--set",
            "env.horizon_steps=16",
            "--out",
            str(tmp_path / "run"),
        ]
        assert main(["eval", *arguments, *settings]) == 0
        run = read_run(tmp_path / "run")
        assert {(r.policy, r.n_action_steps, r.n_inferences) for r in run.records} == {("mine", 8, 2)}
        recipes = run.description.recipes
        assert recipes["policies/mine"] == recipes["checkpoints/mine"] == checkpoint_sha256(folder)
        assert recipes[f"datasets/{FACTS.dataset}"] == FACTS.dataset_sha256

    def test_a_folder_without_a_checkpoint_says_what_is_in_it(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "notes.txt").touch()
        assert main(["eval", "--task", TASK, "--policy", str(tmp_path)]) == 1
        assert "expected a LeRobot checkpoint" in capsys.readouterr().err
