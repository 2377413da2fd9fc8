"""Which policies are served, and what the server says of them."""

import pytest

from vla_eval.checkpoints.files import file_sha256
from vla_eval.config.files import find_recipe
from vla_eval.core import EpisodeStart, Observation, ObservationWindow
from vla_eval.errors import RecipeError, SpecMismatchError, UnknownNameError
from vla_eval.policies.controls.scripted import HoldPolicy, RandomPolicy
from vla_eval.policies.registry import POLICIES, PRIVILEGED
from vla_eval.serving.host import HostOptions, host_policy


class TestScripted:
    def test_a_scripted_policy_plans_as_many_actions_as_are_executed(self) -> None:
        hosted = host_policy(HostOptions(policy="random", n_action_steps=5))

        start = EpisodeStart(slot=0, task="any", seed=1, run=0, instruction="go", horizon_steps=9)
        hosted.policy.reset([start])
        window = ObservationWindow(slot=0, frames=(Observation(step=0, images={}, state={}),))
        assert hosted.policy.act(window).actions.shape == (5, 7)
        assert (hosted.metadata.chunk_size, hosted.metadata.n_action_steps) == (5, 5)

    def test_the_server_says_recipe_inputs_and_that_there_are_no_weights(self) -> None:
        said = host_policy(HostOptions(policy="hold", max_batch=4)).metadata

        assert said.name == "hold"
        assert said.recipe_sha256 == file_sha256(find_recipe("policies", "hold"))
        assert said.weights_known and said.weights_sha256 is None
        assert said.cameras == {} and said.state_layouts is not None
        assert {name: len(dims) for name, dims in said.state_layouts.items()} == {"qpos": 9}
        assert not said.needs_every_frame
        assert said.batch_max == 1  # it infers for one episode at a time

    @pytest.mark.parametrize("policy", sorted(PRIVILEGED))
    def test_a_policy_that_reads_the_true_state_is_refused(self, policy: str) -> None:
        with pytest.raises(SpecMismatchError, match="the true state of the world, which is not sent"):
            host_policy(HostOptions(policy=policy))

    def test_all_of_ours_that_read_the_true_state_are_known(self) -> None:
        assert set(POLICIES) > PRIVILEGED
        assert not (RandomPolicy.privileged or HoldPolicy.privileged)


class TestMistakes:
    def test_a_policy_behind_a_socket_is_refused(self) -> None:
        with pytest.raises(SpecMismatchError, match="'remote_ours' is behind a socket already"):
            host_policy(HostOptions(policy="remote_ours"))

    def test_a_mistyped_policy_or_task_gets_a_suggestion(self) -> None:
        with pytest.raises(UnknownNameError, match="Did you mean 'random'"):
            host_policy(HostOptions(policy="randon"))
        with pytest.raises(UnknownNameError, match="Did you mean 'RememberColor3-v0'"):
            host_policy(HostOptions(policy="random", task="RemmeberColor3-v0"))

    @pytest.mark.parametrize("max_batch", [0, 5000])
    def test_the_rows_of_a_pass_have_a_range(self, max_batch: int) -> None:
        with pytest.raises(RecipeError, match=f"max_batch is {max_batch}"):
            HostOptions(policy="random", max_batch=max_batch)

    def test_a_device_for_a_policy_that_takes_none_is_refused(self) -> None:
        with pytest.raises(RecipeError, match="'random' does not take the recipe's args"):
            host_policy(HostOptions(policy="random", device="cpu"))
