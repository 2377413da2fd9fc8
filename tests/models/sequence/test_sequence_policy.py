"""Plain policies: they act as they were trained, and remember only where their core does."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.models.sample_frames import BASE, WRIST, at, between, frames
from tests.models.sequence.test_sequence_parts import SMALL_OPTIONS
from tests.training.fitted_policies import policy_config
from vla_eval.config.files import load_recipe, to_data
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.data.tables import read_columns
from vla_eval.errors import RecipeError
from vla_eval.models.cores.sizes import CORES
from vla_eval.models.episodes.samples import Episodes, episodes_of
from vla_eval.models.sequence.modeling_sequence import Demonstrated, MikasaSequencePolicy
from vla_eval.training.dataset import training_dataset

TINY = {"width": 16, "heads": 2, "context_steps": 2, "chunk_size": 3, "n_action_steps": 2}
RETURNS = {"tokens": "return_observation_action", "reward": "sparse"}


def tiny_policy(recorded: Path, **fields: Any) -> Any:
    torch.manual_seed(0)
    fields.setdefault("core_options", SMALL_OPTIONS.get(fields.get("core", ""), {}))
    recipe = FinetuneRecipe(type="mikasa_sequence", policy={**TINY, **fields})
    dataset = training_dataset(recorded, allow_unreplayed=True)
    return MikasaSequencePolicy(policy_config(recipe, dataset, device="cpu")).eval()


def predicted(policy: MikasaSequencePolicy, tokens: Tensor, answers: Tensor) -> Tensor:
    return policy.network.chunks(policy.network.decide(tokens, answers))


@pytest.mark.parametrize("core", CORES)
def test_it_acts_frame_by_frame_as_it_was_trained_on_whole_episodes(recorded: Path, core: str) -> None:
    policy, seen = tiny_policy(recorded, core=core), frames(5, n_episodes=2)
    tokens = policy.network.tokens(torch.stack([seen[BASE], seen[WRIST]], dim=2), seen["observation.state"])
    whole = predicted(policy, tokens, policy.network.read(tokens, policy.network.begin(2))[0])
    memory = None
    for first, stop in ((0, 1), (1, 4), (4, 5)):  # the harness shows what is new since it last asked
        if CORES[core].remembers:
            memory = policy.remember(between(seen, first, stop), memory)
        chunk = policy.predict_action_chunk(at(seen, stop - 1), memory=memory)
        torch.testing.assert_close(chunk, whole[:, stop - 1].clamp(-1, 1), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("core", ["gru", "transformer", "mlp"])
def test_under_autocast_all_but_the_encoders_convolutions_stay_in_float32(recorded: Path, core: str) -> None:
    policy, seen = tiny_policy(recorded, core=core), frames(3, n_episodes=2)
    network, images = policy.network, torch.stack([seen[BASE], seen[WRIST]], dim=2)
    with torch.autocast("cpu", torch.bfloat16):
        encoded = network.encoders[0].features(images[:, 0, 0])
        tokens = network.tokens(images, seen["observation.state"])
        answers, memory = network.read(tokens, network.begin(2))
        decided = network.decide(tokens, answers)
        made = network.chunks(decided), network.goal_m(decided)
    assert encoded.dtype == torch.bfloat16
    halves = {torch.bfloat16, torch.float16}
    assert not halves & {x.dtype for x in (tokens, answers, *memory, *made)}
    exact = network.tokens(images, seen["observation.state"])
    torch.testing.assert_close(tokens, exact, atol=0.02, rtol=0.02)


@pytest.mark.parametrize("core", CORES)
def test_when_it_acts_it_reads_the_target_return_and_the_actions_that_it_has_decided_on(
    recorded: Path, core: str
) -> None:
    """As if a demonstration with these returns and actions had been read."""
    policy = tiny_policy(recorded, core=core, **RETURNS, target_return=2.5)
    seen, memory, chunks = frames(5, n_episodes=2), None, []
    for step in range(5):
        if CORES[core].remembers:
            memory = policy.remember(between(seen, step, step + 1), memory)
        chunks.append(policy.predict_action_chunk(at(seen, step), memory=memory))
    images = torch.stack([seen[BASE], seen[WRIST]], dim=2)
    with torch.no_grad():
        tokens = policy.network.tokens(images, seen["observation.state"])
        actions = torch.stack([chunk[:, 0] for chunk in chunks], dim=1)
        given = Demonstrated(returns=torch.full((2, 5), 2.5), actions=actions)
        whole = predicted(policy, tokens, policy.network.answers(tokens, given)).clamp(-1, 1)
    torch.testing.assert_close(torch.stack(chunks, dim=1), whole, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("core", CORES)
def test_with_returns_and_without_actions_it_acts_as_if_a_demonstration_had_been_read(
    recorded: Path, core: str
) -> None:
    fields = {"tokens": "return_observation", "reward": "sparse", "target_return": 2.5}
    policy, seen = tiny_policy(recorded, core=core, **fields), frames(5, n_episodes=2)
    tokens = policy.network.tokens(torch.stack([seen[BASE], seen[WRIST]], dim=2), seen["observation.state"])
    given = Demonstrated(returns=torch.full((2, 5), 2.5), actions=torch.full((2, 5, 7), torch.nan))
    whole = predicted(policy, tokens, policy.network.answers(tokens, given))
    memory = None
    for step in range(5):
        if CORES[core].remembers:
            memory = policy.remember(between(seen, step, step + 1), memory)
        chunk = policy.predict_action_chunk(at(seen, step), memory=memory)
        torch.testing.assert_close(chunk, whole[:, step].clamp(-1, 1), atol=1e-5, rtol=1e-5)


def test_another_target_return_gives_other_actions(recorded: Path) -> None:
    seen = frames(1)
    chunks = []
    for target in (0.0, 1.0):
        policy = tiny_policy(recorded, core="rate", **RETURNS, target_return=target)
        memory = policy.remember(between(seen, 0, 1), None)
        chunks.append(policy.predict_action_chunk(at(seen, 0), memory=memory))
    assert not torch.allclose(*chunks)


def test_the_target_of_sparse_rewards_is_one_and_of_dense_ones_the_best_of_the_dataset(
    recorded: Path,
) -> None:
    assert tiny_policy(recorded, **RETURNS).config.target_return == 1.0
    dense = tiny_policy(recorded, **{**RETURNS, "reward": "dense"}).config.target_return
    columns = read_columns(recorded)
    sums = [columns["next.reward"][columns["episode_index"] == episode].sum() for episode in range(4)]
    assert dense == pytest.approx(max(sums), rel=1e-5)


def test_tokens_of_returns_without_a_kind_of_reward_are_refused(recorded: Path) -> None:
    with pytest.raises(
        RecipeError, match=r"reward is None, expected dense or sparse.*reads the return to go"
    ):
        tiny_policy(recorded, tokens="return_observation_action")
    with pytest.raises(RecipeError, match=r"reward and target_return belong to tokens=return"):
        tiny_policy(recorded, reward="sparse")


def test_without_goal_and_weights_the_loss_is_the_mean_squared_error(recorded: Path) -> None:
    plain = {"goal_weight": 0.0, "change_weight": 0.0, "waiting_share": 1.0, "first_action_weight": 1 / 3}
    policy = tiny_policy(recorded, head="linear", encoder="nature_stacked", state_in_token=False, **plain)
    batch = demonstrations(policy, n_episodes=2)
    with torch.no_grad():
        loss, _ = policy.train().forward(batch)
        images = torch.stack([batch[BASE], batch[WRIST]], dim=2)[:, :-1]
        tokens = policy.network.tokens(images, batch["observation.state"][:, :-1])
        found = predicted(policy, tokens, policy.network.answers(tokens, None))
    wanted = batch["action"].unfold(1, 3, 1).transpose(-1, -2)
    torch.testing.assert_close(loss, (found - wanted).square().mean(), atol=1e-5, rtol=1e-5)


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
    with pytest.raises(RecipeError, match=r"width is 15, expected a multiple of 2 for the core 'rate'"):
        tiny_policy(recorded, core="rate", width=15)


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


def demonstrations(policy: Any, *, n_episodes: int) -> dict[str, torch.Tensor]:
    """Return a batch of episodes as long as the window, with random actions."""
    n_steps, chunk = policy.config.n_window_steps, policy.config.chunk_size
    batch = frames(n_steps + 1, n_episodes=n_episodes)
    draws = torch.Generator().manual_seed(2)
    batch["action"] = 2 * torch.rand(n_episodes, n_steps + chunk - 1, 7, generator=draws) - 1
    batch["action_is_pad"] = torch.zeros(n_episodes, n_steps + chunk - 1, dtype=torch.bool)
    batch["observation.state_is_pad"] = torch.zeros(n_episodes, n_steps + 1, dtype=torch.bool)
    return batch


def test_more_wrong_things_may_stay_the_longer_it_is_trained_also_after_a_resume(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shares: list[float] = []

    def noted(*args: Any, may_stay: float, **options: Any) -> Episodes:
        shares.append(may_stay)
        return episodes_of(*args, may_stay=may_stay, **options)

    monkeypatch.setattr("vla_eval.models.episodes.policy.episodes_of", noted)
    policy = tiny_policy(recorded, decision_share=0.5, erase_share=0.5, erase_warmup_episodes=10)
    batch = demonstrations(policy, n_episodes=4)
    policy.forward(batch)  # not training
    policy.train().forward(batch)
    policy.forward(batch)
    policy.save_pretrained(tmp_path)
    resumed = MikasaSequencePolicy.from_pretrained(tmp_path).train()
    for _ in range(2):
        resumed.forward(batch)
    assert shares == pytest.approx([1, 0, 0.4**2, 0.8**2, 1])


def test_the_mean_of_all_goals_misses_one_variance(recorded: Path) -> None:
    policy = tiny_policy(recorded)
    batch = demonstrations(policy, n_episodes=2)
    with torch.no_grad():
        policy.network.goal.weight.zero_()
        policy.network.goal.bias.copy_(5 * batch["observation.state"][:, -1, :3].mean(dim=0))
    _, parts = policy.forward(batch)
    assert parts["goal"] == pytest.approx(1.0, rel=1e-4)
