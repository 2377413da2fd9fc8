"""Octo as a policy: windows and padding as the original's, one episode like many, from data to a table."""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from safetensors.torch import load_file
from torch import Tensor

from tests.models.golden_values import GoldenValues
from tests.models.octo.tiny_octo import GOLDEN, TINY
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.chunking import ChunkingSpec
from vla_eval.cli.main import main
from vla_eval.config.environment import EnvSettings
from vla_eval.config.files import load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.core import EpisodeStart, Observation, ObservationWindow
from vla_eval.envs.factory import make_env
from vla_eval.errors import CheckpointError, MissingInstructionError
from vla_eval.features import ACTION_NAMES
from vla_eval.models.octo.configuration_octo import TRAINED, MikasaOctoConfig
from vla_eval.models.octo.conversion import octo_config
from vla_eval.models.octo.language import PromptEmbeddings
from vla_eval.models.octo.modeling_octo import MikasaOctoPolicy
from vla_eval.models.weights.trainable import trainable
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.storage.run_folder import read_run

TASK = "RememberColor3-v0"
BASE, WRIST = "observation.images.base", "observation.images.wrist"
CHUNK_KEYS = (
    *("trajectory_actions", "observation_index", "actions"),
    *("timestep_pad_mask", "action_pad_mask", "task_completed"),
)


def tiny_policy(**fields: Any) -> MikasaOctoPolicy:
    torch.manual_seed(0)
    return MikasaOctoPolicy(octo_config({**TINY, **fields})).eval()


def batch(policy: MikasaOctoPolicy, *, n: int = 2, n_missing: int = 0) -> dict[str, Any]:
    config, draws = policy.config, torch.Generator().manual_seed(1)
    n_steps = config.window + config.chunk_size - 1
    before = (torch.arange(config.window) < n_missing).expand(n, -1)
    return {
        **{key: torch.rand(n, config.window, 3, 24, 24, generator=draws) for key in (BASE, WRIST)},
        **{f"{key}_is_pad": before for key in (BASE, WRIST)},
        "action": torch.rand(n, n_steps, 7, generator=draws),
        "action_is_pad": (torch.arange(n_steps) < n_missing).expand(n, -1).clone(),
        "index": torch.arange(n),
        OBS_LANGUAGE_TOKENS: torch.arange(config.language_tokens).expand(n, -1) + 3,
        OBS_LANGUAGE_ATTENTION_MASK: torch.ones(n, config.language_tokens, dtype=torch.bool),
    }


@pytest.fixture(scope="module")
def golden() -> GoldenValues:
    return GoldenValues(GOLDEN / "io.safetensors")


class TestWindows:
    @pytest.mark.parametrize("name", ["chunk_full", "chunk_w2"])
    def test_training_targets_are_the_originals_where_they_count(
        self, golden: Mapping[str, Tensor], name: str
    ) -> None:
        """From a trajectory as lerobot gives it: ends repeated, and flags for what is beyond."""
        stored = {key: golden[f"data.{name}.{key}"] for key in CHUNK_KEYS}
        actions, windows = stored["trajectory_actions"], stored["observation_index"]
        n_window, n_chunk = stored["actions"].shape[1:3]
        policy = tiny_policy(window=n_window, max_window=n_window, chunk_size=n_chunk)
        for step in range(len(actions)):
            wanted = torch.arange(step - n_window + 1, step + n_chunk)
            assert torch.equal(wanted[:n_window].clamp(min=0), windows[step])
            targets = policy._targets(
                {
                    "action": actions[wanted.clamp(0, len(actions) - 1)][None],
                    "action_is_pad": ((wanted < 0) | (wanted >= len(actions)))[None],
                }
            )
            is_real = stored["timestep_pad_mask"][step]
            assert torch.equal(targets.step_mask[0], is_real)
            counts = is_real[:, None, None] & targets.action_mask[0]
            assert torch.equal(counts, is_real[:, None, None] & stored["action_pad_mask"][step])
            # No action counts once the task is done, which it is after the last step.
            assert torch.equal(counts[..., 0], is_real[:, None] & ~stored["task_completed"][step])
            assert torch.equal(targets.actions[0][counts], stored["actions"][step][counts])

    def test_history_in_an_episode_is_that_of_the_originals_wrapper(
        self, golden: Mapping[str, Tensor]
    ) -> None:
        """8 rows: the reset and 7 steps, each with the frames of a window of 4, also within a chunk."""
        policy = tiny_policy(window=4, max_window=4)
        seen: list[dict[str, Tensor]] = []
        policy.predict_action_chunk = lambda batch: (  # type: ignore[method-assign]
            seen.append(batch) or torch.zeros(1, 4, 7)
        )
        n_actions = 3
        policy.config.n_action_steps = n_actions
        for step in range(7):
            frame = torch.full((1, 3, 2, 2), float(step))
            policy.select_action({BASE: frame, WRIST: frame})
        for number, shown in enumerate(seen):
            row = number * n_actions
            assert (
                shown[BASE][0, :, 0, 0, 0].tolist() == golden["data.history.observation_index"][row].tolist()
            )
            assert torch.equal(~shown[f"{BASE}_is_pad"][0], golden["data.history.timestep_pad_mask"][row])
        assert len(seen) == math.ceil(7 / n_actions)

    def test_what_lies_before_the_episode_changes_nothing_and_what_lies_in_it_does(self) -> None:
        policy = tiny_policy()
        given = batch(policy, n_missing=7)
        noise = torch.randn(2, *policy.config.noise_shape)
        chunk = policy.predict_action_chunk(given, noise=noise)
        for step, changes in ((6, False), (7, True)):
            other = {**given, BASE: given[BASE].clone()}
            other[BASE][:, step] = 0.5
            again = policy.predict_action_chunk(other, noise=noise)
            assert torch.equal(again, chunk) is not changes


class TestTraining:
    @pytest.mark.parametrize(("mode", "n_patterns"), [("heads", 1), ("heads_and_positions", 2), ("all", 1)])
    def test_each_mode_trains_just_what_it_names(self, mode: Any, n_patterns: int) -> None:
        policy = tiny_policy(trained=mode)
        policy.train()
        loss, _ = policy.forward(batch(policy))
        loss.backward()
        moved = {name for name, x in policy.named_parameters() if x.grad is not None}
        named = set(trainable(policy))
        heads = {name for name in named if name.startswith("network.head.")}
        positions = {name for name in named if "positions" in name}
        everything = {name for name, _ in policy.network.named_parameters(prefix="network")}
        expected = {"heads": heads, "heads_and_positions": heads | positions, "all": everything}[mode]
        assert named == expected and moved == expected and len(TRAINED[mode]) == n_patterns
        assert positions or mode == "heads"
        kernels, others = policy.get_optim_params()
        assert len(kernels["params"]) + len(others["params"]) == len(named)
        assert others["weight_decay"] == 0.0 and all(x.ndim > 1 for x in kernels["params"])

    def test_decay_is_for_just_the_kernels_of_the_original(self) -> None:
        """The original's rule is `"kernel" in path`; norms have scales there, positions are embeddings."""
        policy = tiny_policy(trained="all")
        stem = (*(f"convolutions.{index}" for index in range(4)), "embedding")
        trunk = [
            *(f"stems.{camera}.{part}" for camera in ("primary", "wrist") for part in stem),
            *("projections.primary", "projections.wrist", "language_projection"),
            *(f"blocks.0.{part}" for part in ("query", "key", "value", "out", "fc1", "fc2")),
        ]
        head = ["time_fc1", "time_fc2", "first", "last", "blocks.0.fc1", "blocks.0.fc2"]
        expected = {
            "network.head.frequencies",  # `time_preprocess.kernel`
            *(f"network.transformer.{name}.weight" for name in trunk),
            *(f"network.head.{name}.weight" for name in head),
        }
        kernels, others = policy.get_optim_params()
        names = {id(x): name for name, x in policy.named_parameters()}
        assert {names[id(x)] for x in kernels["params"]} == expected
        assert "weight_decay" not in kernels and others["weight_decay"] == 0.0

    def test_remembered_readouts_are_computed_once_and_are_the_same(self) -> None:
        policy = tiny_policy(remember_readouts=True, augment=False)
        policy.train()
        given = batch(policy)
        direct = policy._readout(given)
        calls: list[int] = []
        policy.network.transformer.register_forward_hook(lambda *_: calls.append(1))
        for _ in range(2):
            torch.testing.assert_close(policy._remembered(given), direct)
        assert len(calls) == 1

    def test_remembering_does_not_go_with_what_changes(self) -> None:
        with pytest.raises(CheckpointError, match="remember_readouts needs"):
            octo_config({**TINY, "remember_readouts": True})

    def test_an_instruction_is_embedded_once_and_an_empty_one_is_an_error(self) -> None:
        policy, prompts, calls = tiny_policy(), PromptEmbeddings(), []
        policy.language.register_forward_hook(lambda *_: calls.append(1))
        tokens, mask = torch.tensor([[3, 4, 0], [5, 0, 0], [3, 4, 0]]), torch.ones(3, 3, dtype=torch.bool)
        first = prompts(policy.language, tokens, mask)
        assert torch.equal(first[0], first[2]) and torch.equal(prompts(policy.language, tokens, mask), first)
        assert len(calls) == 2
        with pytest.raises(MissingInstructionError):
            prompts(policy.language, tokens, torch.zeros(3, 3, dtype=torch.bool))

    def test_wrong_sizes_are_errors(self) -> None:
        for fields in (
            {"window": 11},
            {"image_px": {"primary": 100, "wrist": 16}},
            {"cameras": {"primary": BASE}},
        ):
            with pytest.raises(CheckpointError, match="not a configuration of Octo"):
                octo_config({**TINY, **fields})


@pytest.mark.parametrize("name", ["octo_small", "octo_base", "octo_tiny"])
def test_each_recipe_is_a_configuration(name: str) -> None:
    section = load_recipe("policies", name, PolicyRecipe).value.finetune
    assert section is not None and section.type == "mikasa_octo"
    config = MikasaOctoConfig(device="cpu", **section.policy)
    assert (config.window, config.chunk_size) == (10, 4)


# ----------------------------------------------------------------------------------- from data to a table


@pytest.fixture(scope="module")
def run(_recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny Octo after two steps, by the command line and without a network."""
    folder = tmp_path_factory.mktemp("octo")
    recipe = folder / "tiny_octo.yaml"
    section = {
        **{"type": "mikasa_octo", "policy": {**TINY, "trained": "all"}, "steps": 2, "batch_size": 2},
        **{"save_every_steps": 2, "log_every_steps": 1, "num_workers": 0, "decode_ahead": False},
    }
    text = {"version": 1, "description": "tiny", "adapter": "lerobot", "finetune": section}
    recipe.write_text(yaml.safe_dump(text))
    arguments = ["--policy", str(recipe), "--dataset", str(_recorded), "--device", "cpu"]
    assert main(["finetune", *arguments, "--allow-unreplayed", "--out", str(folder / "run")]) == 0
    return folder / "run"


def adapter(run: Path, *, n_slots: int = 1) -> LeRobotPolicy:
    made: Any = make_env(EnvSettings(task=TASK, simulator="fake"))
    context = PolicyContext(
        name="octo", env=made.spec, chunking=ChunkingSpec(n_action_steps=4), n_candidates=3, n_slots=n_slots
    )
    return make_lerobot(context, checkpoint=str(run), device="cpu")


def episode(slot: int) -> EpisodeStart:
    return EpisodeStart(slot=slot, task=TASK, seed=10 + slot, run=0, instruction="touch it", horizon_steps=30)


def frames(slot: int, first: int, stop: int) -> tuple[Observation, ...]:
    rng = np.random.default_rng(slot)
    images = rng.integers(0, 256, (stop, 2, 128, 128, 3), dtype=np.uint8)
    return tuple(
        Observation(step=n, images={"base_camera": images[n, 0], "hand_camera": images[n, 1]}, state={})
        for n in range(first, stop)
    )


def in_float64(policy: LeRobotPolicy) -> LeRobotPolicy:
    """So that a difference is no more than float32 of the actions: twenty steps add up rounding."""
    network: Any = policy._loaded.policy
    network.double()
    resized = network._images
    network._images = lambda camera, images: resized(camera, images).double()
    return policy


class TestInTheHarness:
    def test_it_reads_every_frame_and_needs_no_proprioception(self, run: Path) -> None:
        policy = adapter(run)
        assert (policy.spec.reads, policy.spec.chunk_size, policy.spec.states) == ("every", 4, ())
        assert policy.spec.cameras == ("base_camera", "hand_camera")

    def test_several_episodes_in_one_pass_get_the_actions_they_get_alone(self, run: Path) -> None:
        together = in_float64(adapter(run, n_slots=3))
        # In slots 5, 6, 7 of a server, and in rows 2, 1, 0 of a pass.
        together.reset([replace(episode(slot), slot=slot + 5, row=2 - slot) for slot in range(3)])
        alone = [in_float64(adapter(run)) for _ in range(3)]
        for slot, policy in enumerate(alone):
            policy.reset([replace(episode(slot), slot=0)])
        for first, stop in ((0, 1), (1, 5), (5, 9)):
            windows = [
                ObservationWindow(slot=slot + 5, frames=frames(slot, first, stop)) for slot in range(3)
            ]
            chunks = together.act_batch(windows)
            for slot, policy in enumerate(alone):
                (single,) = policy.act_batch([ObservationWindow(slot=0, frames=frames(slot, first, stop))])
                np.testing.assert_allclose(chunks[slot].actions, single.actions, rtol=1e-6, atol=1e-6)
        assert np.abs(chunks[0].actions - chunks[1].actions).max() > 1e-3  # noise of their own

    def test_an_evaluation_with_chunks_of_four_and_context_ten_appears_in_the_table(
        self, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        out = tmp_path / "evaluation"
        fake = ["--set", "simulator=fake", "--set", "env.horizon_steps=12"]
        arguments = ["--task", TASK, "--policy", str(run), "--n-action-steps", "4", "--episodes", "1"]
        assert main(["eval", *arguments, "--workers", "1", *fake, "--out", str(out)]) == 0
        (record,) = read_run(out).records
        # 12 steps: inferences at 0, 4 and 8, given 1, 4 and 4 frames.
        assert (record.n_inferences, record.n_frames, record.n_steps) == (3, 9, 12)
        assert "run-000002" in capsys.readouterr().out

    def test_the_checkpoint_names_its_statistics_and_has_no_proprioception(self, run: Path) -> None:
        folder = find_checkpoint(run)
        steps = json.loads((folder / "policy_preprocessor.json").read_text())["steps"]
        encoder = next(step for step in steps if step.get("registry_name") == "mikasa_encoder")
        assert encoder["config"]["fields"]["action"]["mask"] == [True] * 6 + [False]
        state = load_file(folder / encoder["state_file"])
        assert set(state) == {"action/mean", "action/std"}
        assert state["action/mean"].shape == (len(ACTION_NAMES),)
        assert "observation.state" not in json.loads((folder / "config.json").read_text())["input_features"]
