"""Names of captured files."""

from pathlib import Path

from vla_eval.records import EpisodeRecord
from vla_eval.storage import capture_files
from vla_eval.storage.capture_files import EPISODE_FILES, EpisodeFile, video_file


def test_the_namespace_of_a_task_is_no_folder() -> None:
    record = EpisodeRecord(
        task="mikasa_vla/RememberColor3-VLA-v0",
        policy="hold",
        n_action_steps=1,
        run=0,
        seed=7,
        outcome="failure",
    )
    assert video_file(Path("run"), record) == Path(
        "run/videos/mikasa_vla_RememberColor3-VLA-v0_hold_K1_run0_seed7_failure.mp4"
    )


def test_what_copies_the_files_of_an_episode_knows_every_kind_and_no_two_are_one_file() -> None:
    kinds = [one for one in vars(capture_files).values() if isinstance(one, EpisodeFile)]
    assert set(kinds) == set(EPISODE_FILES)
    assert len({(one.folder, one.ending) for one in EPISODE_FILES}) == len(EPISODE_FILES)
