"""The positive control: a memory reaches back to the first frame, its twin has none, all else is alike."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.models.sample_frames import BASE, WRIST, at, between, frames
from tests.training.fitted_policies import policy_config
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.files import load_recipe, to_data
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.errors import SpecMismatchError, UnknownNameError
from vla_eval.models.episodes.config import POSITION_SCALE
from vla_eval.models.episodes.samples import episodes_of
from vla_eval.models.memory.modeling_memory import MikasaMemoryPolicy, foreseen_alone, goals_missed
from vla_eval.models.memory.network import Answer
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.training.dataset import training_dataset
from vla_eval.training.finetune import finetune

TASK = "RememberColor3-v0"
TINY = {"channels": 4, "heads": 2, "key": 4, "memory": 8, "hidden": 16, "chunk_size": 3, "n_action_steps": 2}


def tiny_policy(recorded: Path, *, remembers: bool = True, **fields: Any) -> Any:
    torch.manual_seed(0)
    recipe = FinetuneRecipe(type="mikasa_memory", policy={**TINY, "remembers": remembers, **fields})
    dataset = training_dataset(recorded, allow_unreplayed=True)
    return MikasaMemoryPolicy(policy_config(recipe, dataset, device="cpu")).eval()


class TestMemory:
    def test_an_answer_depends_on_the_first_frame_and_the_twins_does_not(self, recorded: Path) -> None:
        seen = frames(6)
        other = {key: values.clone() for key, values in seen.items()}
        other[BASE][:, 0] = 1 - other[BASE][:, 0]
        for remembers in (True, False):
            network = tiny_policy(recorded, remembers=remembers).network
            first, second = (
                network(torch.stack([one[BASE], one[WRIST]], dim=2), one["observation.state"]).actions[:, -1]
                for one in (seen, other)
            )
            assert torch.equal(first, second) is not remembers

    def test_both_have_the_same_parameters(self, recorded: Path) -> None:
        shapes = [
            {name: value.shape for name, value in tiny_policy(recorded, remembers=r).state_dict().items()}
            for r in (True, False)
        ]
        assert shapes[0] == shapes[1]

    @pytest.mark.parametrize("remembers", [True, False])
    def test_it_acts_frame_by_frame_as_it_was_trained_on_whole_episodes(
        self, recorded: Path, remembers: bool
    ) -> None:
        policy, seen = tiny_policy(recorded, remembers=remembers), frames(5, n_episodes=2)
        whole = policy.network(torch.stack([seen[BASE], seen[WRIST]], dim=2), seen["observation.state"])
        memory = None
        for first, stop in ((0, 1), (1, 4), (4, 5)):  # the harness shows what is new since it last asked
            if remembers:
                memory = policy.remember(between(seen, first, stop), memory)
            chunk = policy.predict_action_chunk(at(seen, stop - 1), memory=memory)
            expected = foreseen_alone(Answer(*(part[:, stop - 1] for part in whole))).clamp(-1, 1)
            torch.testing.assert_close(chunk, expected, atol=1e-5, rtol=1e-5)

    def test_lerobots_own_loop_gets_the_same_actions_and_forgets_at_a_reset(self, recorded: Path) -> None:
        policy, seen = tiny_policy(recorded), frames(4)
        memory = policy.remember(between(seen, 0, 3), None)
        expected = policy.predict_action_chunk(at(seen, 2), memory=memory)[:, 0]
        for _ in range(2):
            policy.reset()
            actions = [policy.select_action(at(seen, step)) for step in range(3)]
            torch.testing.assert_close(actions[2], expected)  # two actions of a chunk, then it asks again

    def test_asking_it_without_having_shown_the_frame_is_an_error(self, recorded: Path) -> None:
        with pytest.raises(ValueError, match="remember"):
            tiny_policy(recorded).predict_action_chunk(at(frames(1), 0))


class TestWhatIsKept:
    def test_what_stood_out_is_kept_while_nothing_does(self, recorded: Path) -> None:
        network = tiny_policy(recorded).network
        seen = frames(10)
        for key in (BASE, WRIST):
            seen[key] = 0.5 + 0.1 * seen[key][:, :1].expand(-1, 10, -1, -1, -1).clone()  # a grey table
            seen[key][:, :3, :, 40:48, 64:72] = torch.tensor([0.1, 0.9, 0.1])[:, None, None]  # the cue
        pictures = torch.stack([seen[BASE], seen[WRIST]], dim=2)
        sight = network.see(pictures.flatten(0, 1), seen["observation.state"].flatten(0, 1))
        things = network.write(sight, (1, 10), network.begin(1)).things[0, :, :, -5:-2]
        green = torch.tensor([-0.8, 0.8, -0.8])
        torch.testing.assert_close(things[2], green.expand_as(things[2]), atol=0.1, rtol=0)
        torch.testing.assert_close(things[9], things[2], atol=0.1, rtol=0)

    def test_half_of_the_heads_keep_what_they_saw_first_when_as_much_comes_later(
        self, recorded: Path
    ) -> None:
        network = tiny_policy(recorded, heads=4).network
        pictures = 0.5 + 0.1 * frames(1)[BASE].expand(1, 12, 3, 128, 128).clone()  # a grey table
        pictures[:, :3, :, 40:48, 64:72] = torch.tensor([0.1, 0.9, 0.1])[:, None, None]  # the cue
        pictures[:, 6:, :, 40:48, 20:28] = torch.tensor([0.9, 0.1, 0.1])[:, None, None]  # not the cue
        seen, state = torch.stack([pictures, pictures], dim=2), torch.zeros(1, 12, 10)
        with torch.no_grad():
            sight = network.see(seen.flatten(0, 1), state.flatten(0, 1))
            colors = network.write(sight, (1, 12), network.begin(1)).things[0, -1, :, -5:-2]
        green = torch.tensor([-0.8, 0.8, -0.8])
        far = (colors - green).norm(dim=-1).unflatten(0, (2, 4))  # cameras, heads
        assert far[:, :2].max() < 0.2
        assert far[:, 2:].min() > 0.5


class TestPadding:
    def test_an_answer_does_not_depend_on_what_an_episode_is_padded_with(self, recorded: Path) -> None:
        """Two episodes, of 5 steps and of 3; the second frame of the longer one is shown twice."""
        network = tiny_policy(recorded).network
        seen = frames(5, n_episodes=2)
        images = torch.stack([seen[BASE], seen[WRIST]], dim=2)
        state = seen["observation.state"]
        images[0, 2], state[0, 2] = images[0, 1], state[0, 1]
        first = torch.tensor([[1, 1, 0, 1, 1], [1, 1, 1, 0, 0]]).bool()
        real = torch.tensor([[1, 1, 1, 1, 1], [1, 1, 1, 0, 0]]).bool()
        with torch.no_grad():
            padded = network.answers(images[first], state, None, first=first, real=real)
            longer, shorter = network(images[:1], state[:1]), network(images[1:, :3], state[1:, :3])
        for found, of_longer, of_shorter in zip(padded, longer, shorter, strict=True):
            torch.testing.assert_close(found[:1], of_longer, atol=1e-5, rtol=1e-4)
            torch.testing.assert_close(found[1:, :3], of_shorter, atol=1e-5, rtol=1e-4)


class TestTraining:
    def batch(self, policy: Any, *, n_real: int) -> dict[str, torch.Tensor]:
        n_steps, chunk = policy.config.n_window_steps, policy.config.chunk_size
        batch = frames(n_steps + 1, n_episodes=2)
        batch["action"] = torch.rand(2, n_steps + chunk - 1, 7, generator=torch.Generator().manual_seed(2))
        is_pad = torch.zeros(2, n_steps + chunk - 1, dtype=torch.bool)
        is_pad[:, : n_steps - n_real] = True  # before the episode
        is_pad[:, -1] = True  # beyond its end
        batch["action_is_pad"] = is_pad
        batch["observation.state_is_pad"] = torch.cat([is_pad[:, :n_steps], torch.ones(2, 1).bool()], dim=1)
        return batch

    def loss(self, policy: Any) -> torch.Tensor:
        loss, _ = policy.forward(self.batch(policy, n_real=4))
        assert isinstance(loss, torch.Tensor)
        return loss

    def test_what_is_padded_changes_nothing(self, recorded: Path) -> None:
        policy = tiny_policy(recorded)
        batch = self.batch(policy, n_real=4)
        loss, _ = policy.forward(batch)
        n_before = policy.config.n_window_steps - 4
        for key in (BASE, WRIST, "observation.state"):
            batch[key][:, :n_before] = 0.123
        batch["action"][:, :n_before] = 0.9
        batch["action"][:, -1] = -0.9
        changed, _ = policy.forward(batch)
        torch.testing.assert_close(changed, loss)

    def test_the_loss_of_the_mean_is_one_in_units_of_the_variance(self, recorded: Path) -> None:
        policy = tiny_policy(recorded, arm_cameras=[])
        batch = self.batch(policy, n_real=4)
        goals = batch["observation.state"][:, -1, :3]
        layer = policy.network.goal
        with torch.no_grad():
            for each in layer.maps:
                each[-1].weight.zero_()
                each[-1].bias[1:] = goals.mean(dim=0) * POSITION_SCALE
        _, parts = policy.forward(batch)
        assert parts["goal"] == pytest.approx(1.0, rel=1e-4)

    def test_an_episode_of_several_motions_does_not_teach_the_goal(self, recorded: Path) -> None:
        policy = tiny_policy(recorded, goal_of_one_motion=True).train()
        batch = self.batch(policy, n_real=5)
        n_steps = policy.config.n_window_steps
        batch["action"][:, :, :3] = 0.0
        batch["action"][:, n_steps - 4, :3] = 1.0  # both set out; then, the second does so again
        batch["action"][1, n_steps - 2, :3] = 1.0
        goals = batch["observation.state"][:, -1, :3]  # a view
        missed = []
        for _ in range(2):
            _, parts = policy.forward(batch)
            missed.append(parts["goal"] * float((goals - goals.mean(dim=0)).square().mean()))
            goals[1] += 1.0  # the second ends elsewhere: that changes the unit, the variance, alone
        assert missed[1] == pytest.approx(missed[0], rel=1e-3)

    def test_where_no_episode_teaches_the_goal_the_rest_is_learned(self, recorded: Path) -> None:
        policy = tiny_policy(recorded, goal_of_one_motion=True).train()
        batch = self.batch(policy, n_real=5)
        batch["action"][:, ::2, :3] = 1.0  # sets out again and again
        batch["action"][:, 1::2, :3] = 0.0
        before = policy.network.goal.usual_error.clone()
        loss, parts = policy.forward(batch)
        loss.backward()
        assert parts["goal"] == 0 and parts["imitation"] > 0
        assert torch.isfinite(loss) and torch.equal(policy.network.goal.usual_error, before)

    def test_waiting_is_thinned_but_the_first_and_the_sampled_frame_stay(self, recorded: Path) -> None:
        policy = tiny_policy(recorded, waiting_share=1e-6).train()
        batch = self.batch(policy, n_real=5)
        batch["action"][:] = 0.5
        episodes = episodes_of(batch, policy.config, training=True)
        n_steps = policy.config.n_window_steps
        assert episodes.state.shape[1] == 2
        torch.testing.assert_close(episodes.state[:, 0], batch["observation.state"][:, n_steps - 5])
        torch.testing.assert_close(episodes.state[:, 1], batch["observation.state"][:, n_steps - 1])

    @pytest.mark.parametrize("share", [0.0, 1.0])
    def test_an_episode_that_ends_at_a_decision_ends_where_the_arm_begins_to_move(
        self, recorded: Path, share: float
    ) -> None:
        policy = tiny_policy(recorded, waiting_share=1.0, decision_share=share).train()
        batch = self.batch(policy, n_real=5)
        n_steps = policy.config.n_window_steps
        batch["action"][:] = 0.5
        batch["action"][:, n_steps - 2 :] = torch.rand_like(batch["action"][:, n_steps - 2 :])
        kept = episodes_of(batch, policy.config, training=True).state
        expected = batch["observation.state"][:, n_steps - 5 : n_steps - 1 if share else n_steps]
        torch.testing.assert_close(kept, expected)

    def test_an_episode_without_waiting_is_used_to_its_end(self, recorded: Path) -> None:
        policy = tiny_policy(recorded, decision_share=1.0).train()
        batch = self.batch(policy, n_real=5)
        batch["action"] = torch.rand_like(batch["action"])
        assert episodes_of(batch, policy.config, training=True).state.shape[1] == 5

    def test_chunks_that_reach_beyond_the_end_of_an_episode_are_trained_on(self, recorded: Path) -> None:
        assert getattr(tiny_policy(recorded).config, "drop_n_last_frames", 0) == 0

    def test_each_camera_is_taught_to_tell_by_itself(self, recorded: Path) -> None:
        policy = tiny_policy(recorded)
        policy.network.goal.train()
        with torch.no_grad():
            policy.network.goal.camera_trust.copy_(torch.tensor([1e4, 0.0]))  # the second is not listened to
        self.loss(policy).backward()
        taught = [
            sum(float(p.grad.abs().sum()) for p in each.parameters()) for each in policy.network.goal.maps
        ]
        assert min(taught) > 0

    def test_only_training_notes_how_far_off_each_camera_was(self, recorded: Path) -> None:
        policy = tiny_policy(recorded)
        usual = policy.network.goal.usual_error
        noted = []
        for training in (True, False):
            policy.train(training).forward(self.batch(policy, n_real=4))
            noted.append(usual.clone())
        assert (noted[0] != 1).all() and torch.equal(*noted)
        assert torch.equal(policy.state_dict()["network.goal.usual_error"], usual)

    def test_a_window_that_does_not_reach_the_beginning_is_refused(self, recorded: Path) -> None:
        with pytest.raises(SpecMismatchError, match="a memory must begin where the episode does"):
            tiny_policy(recorded, window_steps=2)

    def test_a_camera_on_the_arm_that_is_not_there_is_refused(self, recorded: Path) -> None:
        with pytest.raises(
            UnknownNameError, match=r"arm_cameras .* 'observation.images.wirst'. Did you mean"
        ):
            tiny_policy(recorded, arm_cameras=["observation.images.wirst"])

    def test_a_state_that_does_not_tell_how_the_tool_is_turned_is_refused(self, recorded: Path) -> None:
        config = tiny_policy(recorded).config
        config.robot_state_feature.shape = (25,)
        with pytest.raises(ValueError, match="needs the state 'eef' of 10 numbers, found"):
            config.validate_features()

    @pytest.mark.parametrize(("name", "reads"), [("memory", "every"), ("memoryless", "last")])
    def test_the_recipes_go_from_a_dataset_to_an_episode(
        self, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, reads: str
    ) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        short = {"steps": 2, "batch_size": 2, "save_every_steps": 2, "log_every_steps": 1, "num_workers": 0}
        config = FinetuneConfig(
            policy=name,
            dataset=str(recorded),
            out=str(tmp_path / "run"),
            finetune={**short, "policy": TINY},
            device="cpu",
            allow_unreplayed=True,
        )
        summary = finetune(config)
        again = replace(
            config, out=str(tmp_path / "again"), finetune={**short, "policy": {**TINY, "use_amp": True}}
        )
        finetune(again)  # in the same process, in another precision
        made: Any = make_env(EnvSettings(task=TASK, simulator="fake"))
        context = PolicyContext(
            name=name, env=made.spec, chunking=ChunkingSpec(n_action_steps=2), n_candidates=3
        )
        policy = make_lerobot(context, checkpoint=str(summary.checkpoint))
        assert policy.spec.reads == reads
        env = make_env(EnvSettings(task=TASK, simulator="fake", cameras=("base_camera", "hand_camera")))
        start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="touch it", horizon_steps=6)
        chunking = ChunkingSpec(n_action_steps=2)
        (record,) = rollout(env, policy, [start], RolloutSettings(chunking=chunking))
        assert record.n_steps == 6


def test_the_twins_recipe_differs_in_nothing_but_the_memory() -> None:
    with_memory, without = (
        to_data(load_recipe("policies", name, PolicyRecipe).value) for name in ("memory", "memoryless")
    )
    assert with_memory["finetune"]["policy"].pop("remembers") is True
    assert without["finetune"]["policy"].pop("remembers") is False
    assert with_memory["finetune"] == without["finetune"]


class TestGoalsMissed:
    def missed(self, pointed_m: list[float], shares: list[float]) -> tuple[float, float]:
        """Two episodes of one step, goals 0 and 1 on each axis; look-ups are off by the same in both."""
        right = torch.tensor([[0.0] * 3, [1.0] * 3])
        pointed = right[:, None, None, None] + torch.tensor(pointed_m)[:, None]  # (2, 1, 1, heads, 3)
        believed = torch.tensor(shares).expand(2, 1, 1, -1)
        answer = Answer(
            actions=torch.zeros(2, 1, 1, 7),
            doubts=torch.ones(2, 1, 1),
            goal_m=(believed[..., None] * pointed).sum(dim=(2, 3)),
            pointed_m=pointed,
            shares=believed,
            camera_shares=torch.ones(2, 1, 1),
            evidence=torch.zeros(2, 1, 1, 3),
        )
        goal, loss = goals_missed(answer, right, torch.ones(2, 1))
        return float(goal), float(loss)

    def test_look_ups_whose_errors_cancel_out_are_wrong_all_the_same(self) -> None:
        # The variance of 0 and 1 is 1/4; an error of 1/4 on each axis is 1/16.
        assert self.missed([0.25, -0.25], [0.5, 0.5]) == (0.0, 0.25)

    def test_a_look_up_that_is_not_believed_may_be_wrong(self) -> None:
        assert self.missed([0.0, 5.0], [1.0, 0.0]) == (0.0, 0.0)


class TestForesight:
    def answer(self, doubts: list[float]) -> Answer:
        """Actions of 1, 2, 3 … in all dimensions, with these expected errors (roots of the squares)."""
        n = len(doubts)
        actions = torch.arange(1.0, n + 1)[None, :, None].expand(1, n, 7)
        nowhere = torch.zeros(1, 3)
        return Answer(
            actions=actions,
            doubts=torch.tensor([doubts]).square(),
            goal_m=nowhere,
            pointed_m=nowhere[:, None, None],
            shares=torch.ones(1, 1, 1),
            camera_shares=torch.ones(1, 1),
            evidence=torch.zeros(1, 1, 3),
        )

    def test_a_chunk_is_held_from_its_first_guess_with_the_gripper_as_it_was(self) -> None:
        held = foreseen_alone(self.answer([0.05, 0.06, 0.3, 0.06]))[0]
        assert held[:2].tolist() == [[1.0] * 7, [2.0] * 7]
        assert held[2:].tolist() == [[0.0] * 6 + [2.0]] * 2

    def test_a_policy_that_never_knows_acts_all_the_same(self) -> None:
        answer = self.answer([0.3, 0.34, 0.32, 0.31])
        torch.testing.assert_close(foreseen_alone(answer), answer.actions)

    def test_doubt_learns_the_mean_squared_error_and_teaches_nothing_else(self, recorded: Path) -> None:
        policy = tiny_policy(recorded)
        seen = frames(3)
        pictures = torch.stack([seen[BASE], seen[WRIST]], dim=2)
        policy.network(pictures, seen["observation.state"]).doubts.sum().backward()
        moved = {name for name, p in policy.named_parameters() if p.grad is not None and p.grad.any()}
        assert moved == {"network.acts.doubts.weight", "network.acts.doubts.bias"}
        # The surprise err / d + log d is least where d is the mean of the errors.
        errors, tried = torch.tensor([0.1, 0.2, 0.6]), torch.linspace(0.05, 1, 96)
        surprise = (errors[:, None] / tried + tried.log()).mean(dim=0)
        assert float(tried[surprise.argmin()]) == pytest.approx(0.3, abs=0.011)
