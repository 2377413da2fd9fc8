"""The control `cue_reader`: the oracle where an inference falls into the cue, `cue_blind` where none does."""

import pytest

from tests.policies.test_controls import ActionLog, make_policy, n_successes, privileged_env, run
from vla_eval.core import EpisodeStart, FloatArray, StepResult
from vla_eval.errors import SpecMismatchError


def digests(task: str, policy: str, *, k: int, first: int) -> list[str | None]:
    # The choice begins at step 10.
    records = run(task, policy, (1, 2), n_action_steps=k, first_inference_step=first, horizon_steps=24)
    return [record.trajectory_sha256 for record in records]


@pytest.mark.parametrize(
    "task", ["RememberColor3-v0", pytest.param("BunchOfColors3-v0", marks=pytest.mark.slow)]
)
def test_a_cue_reader_knows_the_cue_only_if_an_inference_falls_into_it(task: str) -> None:
    """The cue is there at steps 0 to 4: K = 8 falls into it from step 4, not from step 5."""
    for first, known in ((4, "oracle"), (5, "cue_blind")):
        expected = digests(task, known, k=8, first=first)
        assert digests(task, "cue_reader", k=8, first=first) == expected
    assert digests(task, "oracle", k=8, first=5) != digests(task, "cue_blind", k=8, first=5)


def test_of_a_chain_a_cue_reader_knows_the_cubes_that_were_there_at_its_inferences() -> None:
    """Three cubes for five steps each. K = 5 falls into each; K = 10 into the first and the third."""

    class Shown(ActionLog):
        def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
            state = result.observation.privileged
            assert state is not None
            shown[result.observation.step] = state.shown_candidates
            right.append(state.right_candidates)

    shown: dict[int, tuple[int, ...]] = {}
    right: list[tuple[int, ...]] = []
    task = "ChainOfColors3-v0"
    (reader,) = run(task, "cue_reader", [1], n_action_steps=5, log=Shown(), horizon_steps=50)
    (oracle,) = run(task, "oracle", [1], n_action_steps=5, horizon_steps=50)
    assert reader.trajectory_sha256 == oracle.trajectory_sha256
    one, two, three = right[0]
    expected = [(one,)] * 4 + [(two,)] * 5 + [(three,)] * 5 + [()] * 5
    assert [shown[step] for step in range(1, 20)] == expected

    # With the first cube known, the first touch is right, but the second one is guessed among seven.
    at_ten = run(task, "cue_reader", (1, 2), n_action_steps=10)
    assert [record.first_choice_success for record in at_ten] == [True, True]
    assert n_successes(at_ten) < 2
    blind = run(task, "cue_blind", (1, 2), n_action_steps=10)
    assert not all(record.first_choice_success for record in blind)


def test_a_cue_reader_of_a_task_without_candidates_is_refused() -> None:
    with pytest.raises(SpecMismatchError, match="which candidate the cue shows"):
        make_policy("cue_reader", privileged_env("InterceptMedium-v0"), 1)
