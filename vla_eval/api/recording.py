"""`vla_eval.record` and `load_dataset`: `mikasa-vla record` from Python, and what it wrote."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any  # plain data

from vla_eval.api.configured import configured, listed
from vla_eval.cli.record import default_folder, record_with_progress, replay_new
from vla_eval.cli.terminal.progress import stop_on_signals
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.data.info_file import one_dataset
from vla_eval.data.opening import OpenDataset, open_dataset
from vla_eval.data.recording.record import RecordingSummary
from vla_eval.errors import DatasetError
from vla_eval.strict.calls import public


@public
def record(
    recipe: DatasetRecipe | str | Path | None = None,
    *,
    tasks: str | Sequence[str] | None = None,
    out: str | Path | None = None,
    replay: bool = True,
    allow_environment_change: bool = False,
    **fields: Any,
) -> RecordingSummary:
    """Record demonstrations, one dataset per task, as `mikasa-vla record` does; the same call resumes.

    Args:
        recipe: a recipe, its file, or the name of one in `datasets/`; None: the arguments say it all.
        tasks: one task id or several.
        out: the folder; None: one in `data/` for each recipe. `.datasets[0].path` is that of the first task.
        replay: replay the episodes at the end, which `finetune` asks for.
        allow_environment_change: resume although package versions or the machine have changed.
        **fields: further fields of `DatasetRecipe`: `episodes`, `seed_start`, `workers`, `env`, ….

    Raises:
        VlaEvalError: a mistake, or a replay that differs from what was recorded.
        KeyboardInterrupt: Ctrl-C; what has finished is kept.
    """
    read = configured(
        DatasetRecipe,
        recipe,
        {"tasks": listed(tasks), **fields},
        folder="datasets",
        start={"name": "demonstrations"},
        needed={"tasks": "tasks"},
        where="record",
    )
    place = Path(out) if out else default_folder(read)
    n_differ = 0
    with stop_on_signals() as stop:
        summary = record_with_progress(
            read,
            stop,
            out=place,
            command="vla_eval.record(…)",
            allow_environment_change=allow_environment_change,
        )
        if replay and not summary.was_stopped:
            n_differ = replay_new(summary, stop, workers=read.workers)
    if stop.is_asked:
        raise KeyboardInterrupt(f"stopped; what was recorded is in {place}, and the same call resumes")
    if n_differ:
        raise DatasetError(f"{place}: episodes did not replay as recorded; the lines above name them.")
    return summary


@public
def load_dataset(folder: str | Path) -> OpenDataset:
    """Open a dataset of this project after comparing all of its files with their digests.

    Its `columns` are the numbers, frame by frame; `lerobot()` is LeRobot's dataset, with the images.

    Args:
        folder: of one dataset, or a folder that holds one.

    Raises:
        DatasetError: it is not finished, or files are missing or not what they were.
    """
    return open_dataset(one_dataset(Path(folder)))
