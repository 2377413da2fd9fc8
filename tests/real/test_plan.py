"""The plan: balanced, random, and the same again; the stages as the paper has them."""

from collections import Counter

import pytest
import scipy.stats

from vla_eval.errors import UnknownNameError
from vla_eval.real.plan import make_plan
from vla_eval.tasks.real_stages import CHANCE, COLORS, PAPER_EPISODES, STAGES, Stage, Trial, stage_of


def test_each_block_has_every_stage_color_and_policy_once() -> None:
    plan = make_plan(["a", "b"], STAGES, episodes=10, seed=3)
    assert [one.trial.number for one in plan] == list(range(1, 3 * 3 * 2 * 10 + 1))
    for block in range(10):
        rows = plan[18 * block : 18 * (block + 1)]
        assert len({(one.trial.stage.name, one.trial.color, one.policy) for one in rows}) == 18


def test_the_order_of_policies_stages_and_places_is_random() -> None:
    plan = make_plan(["a", "b"], STAGES, episodes=40, seed=3)
    firsts = Counter(one.policy for one in plan[::18])
    assert min(firsts["a"], firsts["b"]) >= 10  # 40 fair coins: fewer than 10 heads, p < 0.001
    orders = Counter(one.trial.places for one in plan if one.policy == "a")
    assert len(orders) == 6 and scipy.stats.chisquare(list(orders.values())).pvalue > 0.001


def test_policies_are_paired_by_seed_color_and_places() -> None:
    plan = make_plan(["a", "b"], STAGES, episodes=10, seed=3)
    for stage in STAGES:
        own = {
            policy: {
                one.trial.seed: (one.trial.color, one.trial.places)
                for one in plan
                if one.policy == policy and one.trial.stage == stage
            }
            for policy in ("a", "b")
        }
        assert own["a"] == own["b"] and set(own["a"]) == set(range(30))


def test_it_is_a_function_of_its_seed_and_more_episodes_continue_it() -> None:
    short = make_plan(["a"], STAGES, episodes=2, seed=5)
    assert make_plan(["a"], STAGES, episodes=4, seed=5)[: len(short)] == short
    assert make_plan(["a"], STAGES, episodes=2, seed=6) != short


def test_a_trial_says_what_to_place_and_not_which_policy() -> None:
    assert "policy" not in Trial.__dataclass_fields__
    # Places from the arm's right: red lies third, green first, blue second.
    trial = Trial(number=1, seed=0, stage=stage_of("CubesShuffled"), color=2, places=(2, 0, 1))
    words = [trial.words(phase) for phase in trial.stage.phases]
    assert words[0] == "Put the blue cube on the table, alone: in the middle."
    assert words[1] == "Cover the blue cube."
    assert words[2].startswith("Put the red and green cubes under the cover")
    assert words[2].endswith("From the arm's right: green, blue, red.")
    thrown = Trial(number=1, seed=0, stage=stage_of("CubesThrownIn"), color=0, places=(2, 0, 1))
    assert "on the arm's left" in thrown.words(thrown.stage.phases[0])


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_the_papers_totals_are_the_means_of_its_colors(stage: Stage) -> None:
    rates = stage.paper
    for name in ("touched", "picked"):
        mean = sum(getattr(rates[color], name) for color in COLORS) / len(COLORS)
        assert round(mean, 2) == getattr(rates["Total"], name)


def test_the_papers_third_stage_is_below_chance() -> None:
    n_touched = round(STAGES[2].paper["Total"].touched * PAPER_EPISODES)
    below = sum(scipy.stats.binom.pmf(k, PAPER_EPISODES, CHANCE) for k in range(n_touched + 1))
    assert n_touched == 3 and round(below, 3) == 0.003


def test_a_mistyped_stage_gets_a_suggestion() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'CubesShuffled'"):
        stage_of("CubeShuffled")
