"""Names of captured files."""

from pathlib import Path

from vla_eval.records import EpisodeRecord
from vla_eval.storage.capture_files import video_file


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
