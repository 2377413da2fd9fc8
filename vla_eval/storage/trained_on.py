"""Which episodes of an evaluation have seeds whose demonstrations their policy was trained on."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

from vla_eval.records import EpisodeKey
from vla_eval.seeding import SeedRange
from vla_eval.storage.planned import parts_of

TrainingSeeds = Mapping[str, Mapping[str, Sequence[SeedRange]]]
"""Policy, or its part of a task or run (`part_of`) -> task id -> the seeds of its demonstrations."""


def seeds_of_training(
    known: TrainingSeeds, *, policy: str, task: str, run: int
) -> Sequence[SeedRange] | None:
    """Return the seeds of a task whose demonstrations a policy was trained on; None if that is not known."""
    parts = parts_of(policy, task=task, run=run)
    own = next((known[part] for part in parts if known.get(part)), None)
    return None if own is None else own.get(task, ())


def seen_in_training(keys: Iterable[EpisodeKey], known: TrainingSeeds) -> list[str]:
    """Return a sentence for each policy and task with seeds that are known to be those of demonstrations."""
    seen: dict[tuple[str, str], set[int]] = defaultdict(set)
    asked: dict[tuple[str, str], set[int]] = defaultdict(set)
    for key in keys:
        own = seeds_of_training(known, policy=key.policy, task=key.task, run=key.run)
        if own is None:
            continue
        place = (key.policy, key.task)
        asked[place].add(key.seed)
        if any(key.seed in seeds for seeds in own):
            seen[place].add(key.seed)
    return [
        f"{policy} was trained on demonstrations of {len(seeds)} of the {len(asked[policy, task])} seeds it "
        f"is evaluated on in {task} ({_named(seeds)}): its rate there says nothing of new episodes. Use "
        "other seeds (--seed-start)."
        for (policy, task), seeds in seen.items()
    ]


def _named(seeds: set[int]) -> str:
    return str(min(seeds)) if len(seeds) == 1 else f"from {min(seeds)} to {max(seeds)}"
