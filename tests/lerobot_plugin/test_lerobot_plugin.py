"""Our tasks in LeRobot's own commands: found as a plugin, named as its policies expect, two steps each."""

import importlib
import json
import shutil
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, env_to_policy_features, preprocess_observation
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors.torch import load_file

from tests.training import tiny_trainings
from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import make_env
from vla_eval.errors import RecipeError, SpecMismatchError, UnknownNameError
from vla_eval.features import dataset_features, proprioception
from vla_eval.lerobot_plugin import MikasaEnvConfig, MikasaGym
from vla_eval.results.imported.reading import read_imported
from vla_eval.training.finetune import finetune

TASK = "RememberColor3-v0"
PLUGIN = Path(__file__).parents[2] / "plugins" / "lerobot_env_mikasa"
SHORT = {"cue_steps": 1, "delay_steps": 1}
FAKE = EnvSettings(
    task=TASK, kwargs={"horizon_steps": 4, **SHORT}, simulator="fake", cameras=("base_camera", "hand_camera")
)
HOLD = np.array([0, 0, 0, 0, 0, 0, 1], dtype=np.float32)
ENV_ARGUMENTS = [
    *("--env.type=mikasa", f"--env.task={TASK}", "--env.simulator=fake"),
    "--env.env_kwargs={horizon_steps: 2, cue_steps: 1, delay_steps: 0}",
]
TINY_ACT = [
    *("--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false"),
    *("--policy.pretrained_backbone_weights=null", "--policy.chunk_size=2", "--policy.n_action_steps=2"),
    *("--policy.dim_model=32", "--policy.n_heads=2", "--policy.dim_feedforward=32"),
    *("--policy.n_encoder_layers=1", "--policy.n_vae_encoder_layers=1", "--policy.latent_dim=8"),
]


def make_gym(**changes: Any) -> MikasaGym:
    return MikasaGym(FAKE, **{"state": "eef", "prompt_set": "paper", **changes})


class TestDiscovery:
    def test_lerobot_finds_the_environment_by_the_name_of_the_plugins_distribution(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        project = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]
        name = project["name"]
        shutil.copytree(PLUGIN / name, tmp_path / name)
        info = tmp_path / f"{name}-{project['version']}.dist-info"
        info.mkdir()
        text = f"Metadata-Version: 2.1\nName: {name}\nVersion: {project['version']}\n"
        (info / "METADATA").write_text(text)
        monkeypatch.syspath_prepend(tmp_path)
        register_third_party_plugins()
        assert name in sys.modules
        assert EnvConfig.get_choice_class("mikasa") is MikasaEnvConfig
        del sys.modules[name]

    def test_the_package_can_be_named_where_the_plugin_is_not_installed(self) -> None:
        from lerobot.configs.parser import load_plugin

        load_plugin("vla_eval.lerobot_plugin")
        assert EnvConfig.get_choice_class("mikasa") is MikasaEnvConfig
        assert "mikasa_memory" in PreTrainedConfig.get_known_choices()


class TestNames:
    @pytest.mark.parametrize("state", ["eef", "joints"])
    def test_policies_are_offered_the_fields_of_our_datasets(self, state: Any) -> None:
        offered = env_to_policy_features(MikasaEnvConfig(state=state))
        recorded = dataset_features(state)
        fields = {"observation.images.base", "observation.images.wrist", "observation.state", "action"}
        assert offered.keys() == fields
        for name, feature in offered.items():
            height_first = recorded[name]["shape"]
            # lerobot's policies take channels first.
            is_image = name.startswith("observation.images")
            assert feature.shape == ((3, *height_first[:2]) if is_image else height_first)

    def test_observations_are_what_the_recorder_would_write(self) -> None:
        env = make_gym()
        observation, info = env.reset(seed=7)
        expected = make_env(FAKE).reset({0: 7}, render=True)[0].observation
        assert info == {"is_success": False}
        assert env.observation_space.contains(observation)
        np.testing.assert_array_equal(observation["pixels"]["base"], expected.images["base_camera"])
        np.testing.assert_array_equal(observation["pixels"]["wrist"], expected.images["hand_camera"])
        np.testing.assert_array_equal(observation["agent_pos"], proprioception(expected.state)["eef"])
        np.testing.assert_array_equal(env.render(), expected.images["base_camera"])

        def batched(values: Any) -> Any:
            return {k: batched(v) for k, v in values.items()} if isinstance(values, dict) else values[None]

        tensors = preprocess_observation(batched(observation))
        assert set(tensors) == {"observation.images.base", "observation.images.wrist", "observation.state"}

    def test_the_instruction_is_the_prompt_sets(self) -> None:
        from vla_eval.config.prompts import instruction_for
        from vla_eval.tasks.catalog import task_spec

        assert make_gym().task_description == instruction_for(task_spec(TASK))


class TestEpisodes:
    def test_the_offset_is_added_to_lerobots_seeds(self) -> None:
        plain, moved = make_gym(), make_gym(seed_offset=900)
        np.testing.assert_array_equal(
            plain.reset(seed=905)[0]["pixels"]["base"], moved.reset(seed=5)[0]["pixels"]["base"]
        )

    def test_an_environment_without_a_seed_is_an_error(self) -> None:
        with pytest.raises(SpecMismatchError, match="give lerobot one with --seed"):
            make_gym().reset()
        with pytest.raises(gym.error.ResetNeeded):
            make_gym().step(HOLD)

    def test_resets_without_a_seed_follow_from_the_last_one_given(self) -> None:
        def pictures(env: MikasaGym) -> list[bytes]:
            seen = [env.reset(seed=3)[0], env.reset()[0], env.reset()[0]]
            return [observation["pixels"]["base"].tobytes() for observation in seen]

        assert pictures(make_gym()) == pictures(make_gym())
        assert len(set(pictures(make_gym()))) == 3

    def test_a_finished_episode_stays_finished_until_the_next_rollout(self) -> None:
        config = MikasaEnvConfig(task=TASK, simulator="fake", env_kwargs={"horizon_steps": 3, **SHORT})
        (vector,) = config.create_envs(2)["mikasa"].values()
        vector.reset(seed=[1, 2], options={NEW_ROLLOUT_OPTION: True})
        actions = np.stack([HOLD, HOLD])
        steps = [vector.step(actions) for _ in range(5)]
        assert [list(truncated) for _, _, _, truncated, _ in steps] == [[False] * 2] * 2 + [[True] * 2] + [
            [False] * 2,  # gymnasium's own reset, which is answered with the last picture
            [True] * 2,
        ]
        last, frozen = (steps[index][0]["pixels"]["base"] for index in (2, 4))
        np.testing.assert_array_equal(last, frozen)
        assert [step[4]["is_success"].tolist() for step in steps[:3]] == [[False, False]] * 3
        vector.close()


class TestRefusals:
    @pytest.mark.parametrize(
        ("fields", "error", "message"),
        [
            ({"task": "RemberColor3-v0"}, UnknownNameError, "Did you mean 'RememberColor3-v0'"),
            ({"state": "joint"}, UnknownNameError, "Did you mean 'joints'"),
            ({"max_parallel_tasks": 2}, RecipeError, "expected 1"),
        ],
    )
    def test_what_cannot_work_is_told_when_the_command_line_is_read(
        self, fields: dict[str, Any], error: type[Exception], message: str
    ) -> None:
        with pytest.raises(error, match=message):
            MikasaEnvConfig(**fields)

    def test_a_mistyped_mesh_is_told_before_the_first_episode(self) -> None:
        with pytest.raises(UnknownNameError, match="simplified"):
            MikasaEnvConfig(wrist_mesh="simple").create_envs(1)


@pytest.mark.usefixtures("no_network")
class TestCommands:
    """lerobot's own entry points, in this process."""

    def run(self, command: str, arguments: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> None:
        module: Any = importlib.import_module(f"lerobot.scripts.{command}")
        monkeypatch.setattr(sys, "argv", [command, *arguments])
        monkeypatch.setattr(module, "init_logging", lambda **_: None)  # it would take the root logger over
        module.main()

    def test_lerobot_eval_runs_two_steps_of_two_episodes(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        evaluation = ["--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false"]
        arguments = [*ENV_ARGUMENTS, *TINY_ACT, *evaluation, "--seed=1", f"--output_dir={tmp_path}"]
        self.run("lerobot_eval", arguments, monkeypatch)
        (info,) = tmp_path.glob("eval_info.json")
        overall = json.loads(info.read_text())["overall"]
        assert (overall["n_episodes"], overall["pc_success"]) == (2, 0.0)  # in two steps nobody gets there
        (row,) = read_imported(info)
        assert (row.program, row.n_success, row.n_episodes) == ("lerobot-eval", 0, 2)

    def test_lerobot_train_trains_two_steps_and_evaluates(
        self, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        out = tmp_path / "out"
        arguments = [
            *ENV_ARGUMENTS,
            *TINY_ACT,
            *("--dataset.repo_id=local/tiny", f"--dataset.root={recorded}", f"--output_dir={out}"),
            *("--steps=2", "--batch_size=2", "--num_workers=0", "--save_freq=2", "--log_freq=1"),
            *("--env_eval_freq=2", "--eval.n_episodes=1", "--eval.batch_size=1", "--env.seed_offset=900000"),
        ]
        self.run("lerobot_train", arguments, monkeypatch)
        assert (out / "checkpoints/last/pretrained_model/model.safetensors").is_file()
        assert list(out.glob("eval/videos_step_*/**/*.mp4"))

    @pytest.mark.usefixtures("small_act")
    def test_lerobot_train_goes_on_from_a_checkpoint_of_ours(
        self, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        checkpoint = finetune(tiny_trainings.act(recorded, tmp_path / "run", steps=2)).checkpoint
        config = checkpoint.resolve() / "train_config.json"
        self.run("lerobot_train", [f"--config_path={config}", "--resume=true", "--steps=3"], monkeypatch)
        (later,) = (tmp_path / "run").glob("train/checkpoints/000003")
        assert json.loads((later / "training_state/training_step.json").read_text())["step"] == 3
        before, after = (
            load_file(folder / "pretrained_model/model.safetensors") for folder in (config.parents[1], later)
        )
        assert before.keys() == after.keys()
        # One step of AdamW moves a weight by about the learning rate, 1e-5: it did not start from scratch.
        moved = [float((after[name] - before[name]).abs().max()) for name in before]
        assert 0 < max(moved) < 1e-4
