"""What is said of episodes whose seeds are those of demonstrations."""

from dataclasses import replace

from tests.results.stored_runs import COLOR, episodes, stored
from vla_eval.records import EpisodeKey
from vla_eval.results.report import build_table
from vla_eval.seeding import SeedRange
from vla_eval.storage.trained_on import seen_in_training

TO_FIVE = {COLOR: (SeedRange(first=0, last=5),)}


def keys(*seeds: int, policy: str = "p", run: int = 0, k: int = 1) -> list[EpisodeKey]:
    return [EpisodeKey(COLOR, policy, k, run, seed) for seed in seeds]


def test_a_seed_counts_once_for_all_numbers_of_action_steps() -> None:
    (said,) = seen_in_training([*keys(4, 5, 6), *keys(4, 5, 6, k=8)], {"p": TO_FIVE})
    assert said.startswith("p was trained on demonstrations of 2 of the 3 seeds it is evaluated on")
    assert "(from 4 to 5)" in said


def test_each_of_several_checkpoints_has_its_own_seeds() -> None:
    known = {"p/run-1": TO_FIVE}
    assert seen_in_training(keys(1, run=0), known) == []
    (said,) = seen_in_training([*keys(1, run=0), *keys(2, 9, run=1)], known)
    assert "of 1 of the 2 seeds" in said and "(2)" in said


def test_other_policies_and_tasks_are_not_meant() -> None:
    assert seen_in_training(keys(1, policy="q"), {"p": TO_FIVE}) == []
    assert seen_in_training(keys(1), {"p": {"ShellGameTouch-v0": TO_FIVE[COLOR]}}) == []


def test_the_table_says_so_below() -> None:
    run = stored(episodes("p", "++++++++"))  # seeds 1 to 8
    run = replace(run, description=replace(run.description, training_seeds={"p": TO_FIVE}))
    assert [note for note in build_table([run]).notes if "trained on demonstrations of 5 of the 8" in note]
