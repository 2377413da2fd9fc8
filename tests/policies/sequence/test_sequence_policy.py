"""Plain policies: they act as they were trained, and remember only where their core does."""

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.policies.sample_frames import BASE, WRIST, at, between, frames
from vla_eval.config.files import load_recipe, to_data
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.errors import RecipeError
from vla_eval.policies.sequence.modeling_sequence import MikasaSequencePolicy
from vla_eval.policies.sequence.sizes import CORES
from vla_eval.training.dataset import training_dataset
from vla_eval.training.policy_config import policy_config

TINY = {"width": 16, "heads": 2, "context_steps": 20, "chunk_size": 3, "n_action_steps": 2}


def tiny_policy(recorded: Path, **fields: Any) -> Any:
    torch.manual_seed(0)
    recipe = FinetuneRecipe(type="mikasa_sequence", policy={**TINY, **fields})
    dataset = training_dataset(recorded, allow_unreplayed=True)
    return MikasaSequencePolicy(policy_config(recipe, dataset, device="cpu")).eval()


@pytest.mark.parametrize("core", CORES)
def test_it_acts_frame_by_frame_as_it_was_trained_on_whole_episodes(recorded: Path, core: str) -> None:
    policy, seen = tiny_policy(recorded, core=core), frames(5, n_episodes=2)
    tokens = policy.network.tokens(torch.stack([seen[BASE], seen[WRIST]], dim=2), seen["observation.state"])
    whole = policy.network.predict(tokens, policy.network.read(tokens, policy.network.begin(2))[0]).actions
    memory = None
    for first, stop in ((0, 1), (1, 4), (4, 5)):  # the harness shows what is new since it last asked
        if CORES[core].remembers:
            memory = policy.remember(between(seen, first, stop), memory)
        chunk = policy.predict_action_chunk(at(seen, stop - 1), memory=memory)
        torch.testing.assert_close(chunk, whole[:, stop - 1].clamp(-1, 1), atol=1e-5, rtol=1e-5)


def test_without_a_memory_it_is_not_shown_every_frame(recorded: Path) -> None:
    for core, row in CORES.items():
        assert hasattr(tiny_policy(recorded, core=core), "remember") is row.remembers


def test_asking_it_without_having_shown_the_frame_is_an_error(recorded: Path) -> None:
    with pytest.raises(ValueError, match="remember"):
        tiny_policy(recorded).predict_action_chunk(at(frames(1), 0))


def test_lerobots_own_loop_gets_the_same_actions_and_forgets_at_a_reset(recorded: Path) -> None:
    policy, seen = tiny_policy(recorded), frames(4)
    memory = policy.remember(between(seen, 0, 3), None)
    expected = policy.predict_action_chunk(at(seen, 2), memory=memory)[:, 0]
    for _ in range(2):
        policy.reset()
        actions = [policy.select_action(at(seen, step)) for step in range(3)]
        torch.testing.assert_close(actions[2], expected)


def test_a_core_that_does_not_exist_is_answered_by_the_nearest(recorded: Path) -> None:
    with pytest.raises(RecipeError, match=r"'grue'.*Did you mean 'gru'"):
        tiny_policy(recorded, core="grue")


def test_a_width_that_the_heads_do_not_divide_is_refused(recorded: Path) -> None:
    with pytest.raises(RecipeError, match=r"width is 18, expected a multiple of 2 · heads \(4\)"):
        tiny_policy(recorded, core="transformer", width=18)


def test_the_recipes_differ_in_nothing_but_the_core() -> None:
    recipes = {
        name: to_data(load_recipe("policies", name, PolicyRecipe).value)["finetune"]
        for name in ("recurrent", "context", "bc_mlp")
    }
    cores = {name: recipe["policy"].pop("core") for name, recipe in recipes.items()}
    layers = {name: recipe["policy"].pop("layers", 1) for name, recipe in recipes.items()}
    assert cores == {"recurrent": "gru", "context": "transformer", "bc_mlp": "mlp"}
    assert layers == {"recurrent": 1, "context": 2, "bc_mlp": 2}
    assert recipes["recurrent"] == recipes["context"] == recipes["bc_mlp"]


def test_the_mean_of_all_goals_misses_one_variance(recorded: Path) -> None:
    policy = tiny_policy(recorded)
    n_steps, chunk = policy.config.n_window_steps, policy.config.chunk_size
    batch = frames(n_steps + 1, n_episodes=2)
    batch["action"] = torch.zeros(2, n_steps + chunk - 1, 7)
    batch["action_is_pad"] = torch.zeros(2, n_steps + chunk - 1, dtype=torch.bool)
    batch["observation.state_is_pad"] = torch.zeros(2, n_steps + 1, dtype=torch.bool)
    with torch.no_grad():
        policy.network.goal.weight.zero_()
        policy.network.goal.bias.copy_(5 * batch["observation.state"][:, -1, :3].mean(dim=0))
    _, parts = policy.forward(batch)
    assert parts["goal"] == pytest.approx(1.0, rel=1e-4)
