"""`mikasa-vla record`: record demonstrations, or resume recording."""

import argparse
import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vla_eval.cli.shared.arguments import add_flags, env_paths, read_config, set_flags, typed_command
from vla_eval.cli.shared.cluster import backend_of
from vla_eval.cli.shared.replaying import replay_each
from vla_eval.config.dataset import DatasetRecipe, fingerprint
from vla_eval.config.files import apply_overrides
from vla_eval.storage.shard import shard_folder
from vla_eval.tasks.catalog import task_spec
from vla_eval.workers.backend import Backend
from vla_eval.workers.local import LOCAL
from vla_eval.workers.needed_files import shared_folder

if TYPE_CHECKING:
    from vla_eval.cli.terminal.progress import StopRequest
    from vla_eval.data.recording.record import RecordedDataset, RecordingSummary

DATA_FOLDER = Path("data")
FINGERPRINT_DIGITS = 8
MEGABYTE = 1_000_000
STEPS_PER_SECOND = 25  # a worker, software rendering; docs/speed.md: 25.4 steps in 0.65 s, 39, alone
BYTES_PER_STEP = 11_000  # docs/datasets.md: 70 MB of 6,200 frames
DESCRIPTION = """Record demonstrations of a scripted expert as LeRobot datasets, one per task: OUT/TASK.

RECIPE is a file, or the name of one in datasets/. Without it, name at least one --task. Flags go on top of
the file, --set on top of flags. The same command again resumes where it stopped. At the end the episodes of
each dataset are replayed, which `finetune` asks for."""
EPILOG = """exit codes: 0 all datasets are there; 1 a mistake, or a mismatch in a replay (see the message);
130, 143 stopped by Ctrl-C, SIGTERM (the same command resumes)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, EPILOG
    parser.add_argument("recipe", nargs="?", metavar="RECIPE", help="file, or name in datasets/")
    add_flags(
        parser,
        *("--task", "--workers", "--cluster", "--shard", "--json-progress", "--allow-environment-change"),
        episodes="episodes per task (250)",
        seed_start="the first seed that is tried (1000)",
        out="folder (data/NAME-FINGERPRINT)",
        set="change any field of the recipe",
    )
    parser.add_argument(
        "--no-replay", action="store_true", help="leave out the check that `mikasa-vla replay` does"
    )


def run(args: argparse.Namespace) -> int:
    """Record and replay; the datasets' names go to standard output, everything else to standard error."""
    from vla_eval.cli.shared.output import hint_merge, hint_next
    from vla_eval.cli.terminal.progress import stop_on_signals

    recipe = _recipe(args)
    command = typed_command()
    whole = args.out or default_folder(recipe)
    out = shard_folder(whole, args.shard)
    needs = (shared_folder(out),)
    with backend_of(args, needs=lambda: needs, notes_kinds=False) as backend, stop_on_signals() as stop:
        summary = record_with_progress(
            recipe,
            stop,
            out=out,
            command=command,
            allow_environment_change=args.allow_environment_change,
            json_progress=args.json_progress,
            backend=backend,
            part=args.shard,
        )
        if summary.was_stopped:
            print(f"Stopped. What was recorded is in {out}. To resume: {command}", file=sys.stderr)
            return stop.exit_code
        for dataset in summary.datasets:
            print(describe(dataset), flush=True)
        for part in summary.parts:
            minutes = part.seconds / 60
            print(f"{out}: {part.task}: {part.n_episodes} of {part.n_total} episodes, {minutes:.1f} min")
        if args.shard is not None:
            sys.stdout.flush()
            hint_merge(whole, args.shard)
        code = 0
        if not args.no_replay:
            code = replay_new(
                summary, stop, workers=recipe.workers, backend=backend, json_progress=args.json_progress
            )
    if stop.is_asked:
        print(f"Stopped in the replay check. To resume: {command}", file=sys.stderr)
    elif code == 0 and summary.datasets:
        path = summary.datasets[0].path
        before = ("replay",) if args.no_replay else ("finetune", "--policy", "act", "--dataset")
        hint_next(*before, path)
    return code


def default_folder(recipe: DatasetRecipe) -> Path:
    """Return the folder of a recipe's datasets if none is named."""
    return DATA_FOLDER / f"{recipe.name}-{fingerprint(recipe)[:FINGERPRINT_DIGITS]}"


def record_with_progress(
    recipe: DatasetRecipe,
    stop: "StopRequest",
    *,
    json_progress: int | None = None,
    **arguments: Any,  # of `record`
) -> "RecordingSummary":
    """Record, or resume a recording, with progress on standard error."""
    from vla_eval.cli.terminal.progress import RecordingProgress
    from vla_eval.data.recording.record import record

    with closing(RecordingProgress(stop, json_progress=json_progress)) as progress:
        progress.say(cost(recipe))
        return record(recipe, observer=progress, **arguments)


def replay_new(
    summary: "RecordingSummary",
    stop: "StopRequest",
    *,
    workers: int | Literal["auto"],
    backend: Backend = LOCAL,
    json_progress: int | None = None,
) -> int:
    """Replay the datasets that no replay has passed yet; return the exit code."""
    from vla_eval.cli.terminal.progress import RecordingProgress
    from vla_eval.data.manifest import needs_replay

    paths = [one.path for one in summary.datasets if needs_replay(one.path)]
    if not paths:
        return 0
    progress = RecordingProgress(stop, json_progress=json_progress)
    return replay_each(paths, stop, progress, workers=workers, backend=backend)


def cost(recipe: DatasetRecipe) -> str:
    """Return what the recording takes in all, before it begins."""
    steps = [
        int(recipe.env.get("horizon_steps", task_spec(task).horizon_steps)) * recipe.episodes
        for task in recipe.tasks
    ]
    minutes, megabytes = sum(steps) / STEPS_PER_SECOND / 60, sum(steps) * BYTES_PER_STEP / MEGABYTE
    return (
        f"Tasks: {len(steps)}, episodes each: {recipe.episodes}. In all at most {sum(steps):,} control steps "
        f"with two images: {megabytes:,.0f} MB, {minutes:,.0f} min of one worker on a CPU "
        f"({STEPS_PER_SECOND} steps per second); episodes that end at their success take less."
    )


def describe(dataset: "RecordedDataset") -> str:
    """Return the result of one task, in one line."""
    facts = dataset.facts
    failed = ", ".join(str(one.seed) for one in dataset.failed) or "none"
    if dataset.kept_failures:
        failed = f"kept, {len(dataset.kept_failures)} of {facts.n_episodes} episodes"
    return (
        f"{dataset.path}: {facts.n_episodes} episodes, {facts.n_frames} frames, "
        f"{dataset.n_bytes / MEGABYTE:.1f} MB, {dataset.seconds / 60:.1f} min; failed seeds: {failed}"
    )


def _recipe(args: argparse.Namespace) -> DatasetRecipe:
    def edit(data: dict[str, Any]) -> None:  # Any: plain data of YAML
        set_flags(data, args, ("tasks", "episodes", "seed_start", "workers"))
        apply_overrides(data, args.overrides, cls=DatasetRecipe, free=env_paths(args.overrides))

    return read_config(
        DatasetRecipe,
        edit,
        folder="datasets",
        name=args.recipe,
        start={"name": "demonstrations"},
        asks="a recipe (a file, or one of datasets/), or at least one --task",
        needed={"tasks": "--task"},
        example="record --task RememberColor3-v0 --episodes 10",
    )
