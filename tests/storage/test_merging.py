"""What `merge` refuses, names and links: run folders that were written by hand."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.storage.run_records import describe, error, result
from vla_eval.errors import MergeError
from vla_eval.records import EpisodeKey, EpisodeTiming
from vla_eval.storage.capture_files import EPISODE_FILES
from vla_eval.storage.merging import merge_runs, write_merged
from vla_eval.storage.run_file import RunFile
from vla_eval.storage.run_folder import RunFolder, read_run
from vla_eval.storage.shard import Shard
from vla_eval.storage.timings import read_timings

CONFIG = {"episodes": 4, "seed_start": 0, "runs": 1, "tasks": ["A"], "env": {}}
SHARD = Shard(number=1, count=2, groups=(("A", "oracle", 1),))


def write_shard(out: Path, number: int, *, seeds: tuple[int, ...] | None = None, **changes: object) -> Path:
    """Write shard `number` of two; shard 1 has the seeds 0 and 2, shard 2 has 1 and 3."""
    path = out / f"shard-{number}"
    description = describe(config=CONFIG, shard=replace(SHARD, number=number))
    with RunFolder.open(path, replace(description, **changes)) as folder:  # type: ignore[arg-type]
        for seed in (number - 1, number + 1) if seeds is None else seeds:
            timing = EpisodeTiming(
                key=EpisodeKey("A", "oracle", 1, 0, seed),
                total_seconds=seed,
                reset_seconds=0,
                step_seconds=0,
                inference_seconds=0,
            )
            folder.append(result(seed), timing)
    return path


def test_records_and_timings_are_put_into_the_order_of_the_plan(tmp_path: Path) -> None:
    shards = [write_shard(tmp_path, number) for number in (2, 1)]

    write_merged(merge_runs(shards), tmp_path / "out")

    assert [record.seed for record in read_run(tmp_path / "out").records] == [0, 1, 2, 3]
    timings = read_timings(tmp_path / "out")
    assert [timing.total_seconds for timing in timings.values()] == [0, 1, 2, 3]


def test_a_merged_run_is_continued_as_a_whole_one(tmp_path: Path) -> None:
    shards = [write_shard(tmp_path, number) for number in (1, 2)]
    write_merged(merge_runs(shards), tmp_path / "out")

    with RunFolder.open(tmp_path / "out", describe(config=CONFIG)) as folder:
        assert len(folder.finished_keys()) == 4
    # One session of each shard, and this one.
    assert len(read_run(tmp_path / "out").sessions) == 3


def test_captures_are_linked_and_stay_with_their_shard(tmp_path: Path) -> None:
    shards = [write_shard(tmp_path, number) for number in (1, 2)]
    captured = [one(shards[1], result(3)) for one in EPISODE_FILES]
    for file in captured:
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"of seed 3")

    write_merged(merge_runs(shards), tmp_path / "out")

    merged = [one(tmp_path / "out", result(3)) for one in EPISODE_FILES]
    assert all(one.samefile(other) for one, other in zip(merged, captured, strict=True))
    folders = {path.parent for path in merged}
    assert {path for folder in folders for path in folder.iterdir()} == set(merged)


def test_the_same_shard_twice_is_refused_and_both_are_named(tmp_path: Path) -> None:
    first = write_shard(tmp_path / "a", 1)
    again = write_shard(tmp_path / "b", 1)

    with pytest.raises(MergeError, match=rf"shard 1/2 is named twice: {first} and {again}"):
        merge_runs([first, again])
    with pytest.raises(MergeError, match="shard 1/2 is named twice"):
        merge_runs([first, first])


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"config": {**CONFIG, "env": {"delay_steps": 9}}}, "config.env.delay_steps: (not set) -> 9"),
        ({"recipes": {"policies/oracle": "bb"}}, 'recipes.policies/oracle: "aa" -> "bb"'),
        ({"servers": {"oracle": {"weights_sha256": "cc"}}}, "servers.oracle.weights_sha256"),
        ({"shard": Shard(number=2, count=3, groups=SHARD.groups)}, "shard.count: 2 -> 3"),
    ],
)
def test_another_plan_is_refused_by_the_field_that_differs(
    tmp_path: Path, changes: dict[str, object], field: str
) -> None:
    shards = [write_shard(tmp_path, 1), write_shard(tmp_path, 2, seeds=(1,), **changes)]

    with pytest.raises(MergeError) as refused:
        merge_runs(shards)
    assert field in str(refused.value)


def test_another_environment_is_refused_unless_allowed_and_then_recorded(tmp_path: Path) -> None:
    shards = [write_shard(tmp_path, 1), write_shard(tmp_path, 2, environment={"commit": "c2"})]

    with pytest.raises(MergeError, match=r'environment.commit: "c1" -> "c2"'):
        merge_runs(shards)
    write_merged(merge_runs(shards, allow_environment_change=True), tmp_path / "out")
    changes = [session.environment_changes for session in read_run(tmp_path / "out").sessions]
    assert [[str(change) for change in found] for found in changes] == [
        [],
        ['environment.commit: "c1" -> "c2"'],
    ]


def test_another_device_is_another_environment_and_an_unknown_one_is_not(tmp_path: Path) -> None:
    shards = [write_shard(tmp_path, number) for number in (1, 2)]
    for shard, device in zip(shards, ({"gpu": "A"}, {"gpu": "B"}), strict=True):
        stored = RunFile.load(shard)
        stored.with_device(device, ()).save(shard)

    with pytest.raises(MergeError, match=r'environment.device.gpu: "A" -> "B"'):
        merge_runs(shards)
    write_shard(tmp_path / "blind", 2)
    merged = merge_runs([shards[0], tmp_path / "blind/shard-2"])
    assert merged.run_file.description.environment["device"] == {"gpu": "A"}


def test_missing_shards_and_episodes_are_named(tmp_path: Path) -> None:
    shard = write_shard(tmp_path, 1, seeds=(2,))

    missing = merge_runs([shard]).missing

    assert missing == (
        "demo: no folder of shard 2/2 was named.",
        f"{shard} (shard 1/2): 1 of 2 episodes were not run, such as oracle on A (n_action_steps 1, run 0, "
        "seed 0). To resume: mikasa-vla eval demo",
    )


def test_an_error_is_kept_as_an_error_and_is_not_missing(tmp_path: Path) -> None:
    shards = [write_shard(tmp_path, 1), write_shard(tmp_path, 2, seeds=(1,))]
    with RunFolder.open(shards[1], read_run(shards[1]).description) as folder:
        folder.append(error(3))

    merged = merge_runs(shards)

    assert (merged.missing, merged.n_errors) == ((), 1)
    assert merged.records[3].outcome == "error"


def test_a_whole_run_is_no_shard(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "whole", describe()):
        pass

    with pytest.raises(MergeError, match=r"expected a shard .*found a whole run"):
        merge_runs([tmp_path / "whole"])


def test_an_episode_of_another_shard_is_no_episode_of_this_one(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="the run is shard 1/2, and the seed is in another one"):
        write_shard(tmp_path, 1, seeds=(1,))


def test_nothing_is_written_over(tmp_path: Path) -> None:
    merged = merge_runs([write_shard(tmp_path, number) for number in (1, 2)])
    write_merged(merged, tmp_path / "out")

    with pytest.raises(MergeError, match="exists already"):
        write_merged(merged, tmp_path / "out")
