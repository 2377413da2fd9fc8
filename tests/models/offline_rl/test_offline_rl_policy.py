"""Policies that learn from rewards: what they read, what reaches what, and what they come to prefer."""

from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from torch import Tensor

from vla_eval.config.files import load_recipe, to_data
from vla_eval.config.policy import PolicyRecipe
from vla_eval.errors import RecipeError, UnknownNameError
from vla_eval.models.offline_rl.configuration_offline_rl import ALGORITHMS, MikasaOfflineRLConfig
from vla_eval.models.offline_rl.modeling_offline_rl import OBJECTIVES, MikasaOfflineRLPolicy
from vla_eval.models.offline_rl.network import OfflineRLNetwork

IMAGE_PX = 36  # the smallest that the encoder's three convolutions leave one place of
BASE, WRIST = "observation.images.base", "observation.images.wrist"
FROM_REWARDS = ("cql", "iql")


def config(algorithm: str, *, image_px: int = IMAGE_PX, **fields: Any) -> MikasaOfflineRLConfig:
    reads_rewards = algorithm not in ALGORITHMS or ALGORITHMS[algorithm].reads_rewards
    reward = "success" if reads_rewards else None
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, image_px, image_px))
    return MikasaOfflineRLConfig(
        algorithm=algorithm,
        device="cpu",
        input_features={BASE: image, WRIST: image},
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(2,))},
        **{"width": 8, "hidden": 16, "reward": reward, **fields},
    )


def policy(algorithm: str, **fields: Any) -> MikasaOfflineRLPolicy:
    torch.manual_seed(0)
    return MikasaOfflineRLPolicy(config(algorithm, **fields))


def batch(actions: Tensor, rewards: Tensor, *, is_last: bool = True) -> dict[str, Tensor]:
    """Return transitions between images of one colour each."""
    n_samples = len(actions)
    images = torch.rand(n_samples, 2, 3, 1, 1, generator=torch.Generator().manual_seed(2))
    images = images.expand(-1, -1, -1, IMAGE_PX, IMAGE_PX)
    ends = torch.full((n_samples,), is_last)
    return {
        **{BASE: images, WRIST: images.flip(2)},
        "action": actions[:, None],
        "next.reward": rewards,
        "next.done": ends,
        f"{BASE}_is_pad": torch.stack([torch.zeros_like(ends), ends], dim=1),
    }


def some(n_samples: int = 6, **fields: Any) -> dict[str, Tensor]:
    draws = torch.Generator().manual_seed(1)
    actions = 2 * torch.rand(n_samples, 2, generator=draws) - 1
    return batch(actions, (torch.arange(n_samples) % 2).float(), **fields)


def changed_by(made: MikasaOfflineRLPolicy, seen: dict[str, Tensor]) -> set[str]:
    """Return the parts of the network that the loss has a gradient for."""
    torch.manual_seed(3)
    loss, _ = made.forward(seen)
    loss.backward()
    return {
        name.split(".")[1]
        for name, weight in made.named_parameters()
        if weight.grad is not None and bool((weight.grad != 0).any())
    }


def test_every_algorithm_has_an_objective() -> None:
    assert set(OBJECTIVES) == set(ALGORITHMS)


def test_every_part_that_is_trained_gets_a_gradient_and_the_slow_critics_get_none() -> None:
    shared = {"encoder", "actor", "critics"}
    expected = {"cql": shared | {"log_entropy_weight"}, "cql_published": shared, "iql": shared | {"value"}}
    for algorithm, parts in expected.items():
        made = policy(algorithm)
        assert changed_by(made, some()) == parts
        in_optimizer = {x for group in made.get_optim_params() for x in group["params"]}
        assert in_optimizer == {x for x in made.parameters() if x.requires_grad}


def test_what_the_critics_tell_the_actor_changes_neither_them_nor_the_encoder() -> None:
    made = policy("cql")
    network = made.network
    encoded = torch.rand(3, 8, requires_grad=True)
    actions = torch.rand(3, 2, requires_grad=True)
    network.judge(encoded, actions).sum().backward()
    assert actions.grad is not None and bool((actions.grad != 0).any())
    assert encoded.grad is None
    assert all(weight.grad is None for weight in network.critics.parameters())


def test_slow_critics_follow_by_their_rate() -> None:
    made = policy("iql", target_rate=0.25)
    before = [x.clone() for x in made.network.targets.parameters()]
    with torch.no_grad():
        for weight in made.network.critics.parameters():
            weight += 4.0
    made.update()
    for old, new in zip(before, made.network.targets.parameters(), strict=True):
        torch.testing.assert_close(new, old + 1.0)


def test_the_published_algorithm_reads_no_rewards_and_the_others_do() -> None:
    for algorithm in ALGORITHMS:
        made, losses = policy(algorithm), []
        for rewarded in (0.0, 1.0):
            seen = some()
            seen["next.reward"] = torch.full((6,), rewarded)
            torch.manual_seed(3)
            losses.append(float(made.forward(seen)[0].detach()))
        assert (losses[0] == losses[1]) is (algorithm == "cql_published")


@pytest.mark.parametrize("algorithm", FROM_REWARDS)
def test_the_next_frame_counts_only_where_the_episode_goes_on(algorithm: str) -> None:
    made = policy(algorithm)
    for is_last in (True, False):
        losses = []
        for shade in (0.1, 0.9):
            seen = some(is_last=is_last)
            for camera in (BASE, WRIST):
                seen[camera] = seen[camera].clone()
                seen[camera][:, 1] = shade
            torch.manual_seed(3)
            losses.append(made.forward(seen)[1]["bellman"])
        assert (losses[0] == losses[1]) is is_last


def test_the_encoder_is_the_papers_with_both_cameras_as_six_channels() -> None:
    """Conv2d(6, 32, 8, stride 4) and 9216 inputs of the last layer: RATE, commit 5aa88f0."""
    network = OfflineRLNetwork(config("iql", image_px=128, width=64))
    assert network.encoder[0].in_channels == 6
    assert network.encoder[7].in_features == 9216
    images = torch.rand(2, 3, 2, 3, 128, 128)
    assert network.encode(images).shape == (2, 3, 64)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_it_acts_without_draws_within_the_bounds(algorithm: str) -> None:
    made = policy(algorithm, dropout=0.5).train()
    frames = {BASE: torch.rand(4, 3, IMAGE_PX, IMAGE_PX), WRIST: torch.rand(4, 3, IMAGE_PX, IMAGE_PX)}
    chunk = made.predict_action_chunk(frames)
    assert chunk.shape == (4, 1, 2)
    assert float(chunk.abs().max()) <= 1
    assert torch.equal(made.select_action(frames), chunk[:, 0])


@pytest.mark.parametrize(
    "algorithm",
    [pytest.param(x, marks=pytest.mark.slow) if x == "cql_published" else x for x in ALGORITHMS],
)
def test_who_reads_rewards_comes_to_prefer_what_was_rewarded(algorithm: str) -> None:
    """Half of the recorded actions are +0.5, with reward 1; half are -0.5, without. Their mean is 0."""
    made = policy(algorithm, target_rate=0.1, hidden=32).train()
    sign = torch.tensor([1.0, -1.0]).repeat(4)
    actions = torch.stack([0.5 * sign, torch.zeros(8)], dim=1)
    optimizer = torch.optim.Adam(made.get_optim_params(), lr=1e-2)
    for step in range(100):
        torch.manual_seed(step)
        seen = batch(actions, (sign > 0).float())
        for camera in (BASE, WRIST):  # one state
            seen[camera] = torch.full_like(seen[camera], 0.5)
        loss, _ = made.forward(seen)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        made.update()
    frames = {camera: torch.full((1, 3, IMAGE_PX, IMAGE_PX), 0.5) for camera in (BASE, WRIST)}
    chosen = float(made.select_action(frames)[0, 0])
    assert (chosen > 0.1) is (algorithm in FROM_REWARDS), chosen


def test_dense_rewards_are_not_taken_for_successes() -> None:
    seen = some()
    seen["next.reward"] = torch.rand(6)
    with pytest.raises(ValueError, match="mikasa-vla finetune"):
        policy("iql").forward(seen)
    policy("iql", reward="dense").forward(seen)


def test_an_algorithm_that_does_not_exist_is_answered_by_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match=r"'cqll'.*Did you mean 'cql'"):
        config("cqll")


def test_an_algorithm_gets_rewards_if_it_reads_them() -> None:
    with pytest.raises(RecipeError, match=r"reward of 'iql' is None, expected one of dense, sparse, success"):
        config("iql", reward=None)
    with pytest.raises(RecipeError, match=r"reward of 'cql_published' is dense, expected null"):
        config("cql_published", reward="dense")
    with pytest.raises(UnknownNameError, match=r"'sparce'.*Did you mean 'sparse'"):
        config("iql", reward="sparce")


def test_actions_beyond_the_actors_bounds_are_refused() -> None:
    with pytest.raises(RecipeError, match=r"found a dataset of pd_joint_pos.*pd_joint_delta_pos"):
        config("iql").fit_to_control_mode("pd_joint_pos")


def test_chunks_are_refused() -> None:
    with pytest.raises(RecipeError, match="chunk_size is 4, expected 1"):
        config("iql", chunk_size=4)


def test_the_recipes_have_the_authors_sizes() -> None:
    """run_experiments/MIKASA_Robo/{CQL,IQL}_MLP of RATE, commit 5aa88f0; hidden layers from its code."""
    fields = ("width", "hidden", "dropout", "optimizer_lr", "optimizer_grad_clip_norm")
    expected = {
        "cql": (64, 256, 0.0, 3e-4, 1.0),
        "cql_published": (64, 256, 0.0, 3e-4, 1.0),
        "iql": (128, 128, 0.2, 1e-4, 3.0),
    }
    for name, sizes in expected.items():
        section = to_data(load_recipe("policies", name, PolicyRecipe).value)["finetune"]
        made = config(**{key: value for key, value in section["policy"].items()})
        assert made.algorithm == name
        assert tuple(getattr(made, field) for field in fields) == sizes
        assert (made.optimizer_weight_decay, made.conservative_weight) == (0.1, 1.0)


def test_the_diffusion_policy_beside_them_has_the_papers_frames_and_chunks() -> None:
    """Two frames, 16 predicted actions, 8 executed: ManiSkill's `diffusion_policy`, which the paper names."""
    section = to_data(load_recipe("policies", "diffusion", PolicyRecipe).value)["finetune"]
    made = DiffusionConfig(**section["policy"])
    assert (made.n_obs_steps, made.horizon, made.n_action_steps) == (2, 16, 8)
