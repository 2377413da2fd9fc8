"""`mikasa-vla finetune` and `eval` of a table of learned policies: every part that is missing."""

import argparse
import contextlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from vla_eval.cli.shared.arguments import EXIT_EPISODE_ERRORS, dry_run_options, typed_command
from vla_eval.cli.shared.cluster import backend_of
from vla_eval.cli.shared.output import say
from vla_eval.errors import RecipeError
from vla_eval.evaluation.model_table import (
    EVALUATION_FOLDER,
    Finetuning,
    describe_effort,
    evaluations,
    finetunings,
)
from vla_eval.storage.shard import shard_folder
from vla_eval.studies.study import (
    Study,
    finetune_study,
    needed_files,
    open_study,
    record_tiny,
    tiny_models,
    unfinished,
)
from vla_eval.workers.backend import Backend

FINETUNE_FLAGS = (
    *("dataset", "steps", "batch_size", "run_seed", "base_checkpoint", "held_out_every"),
    *("held_out_episodes", "overrides"),
)
EVAL_FLAGS = (
    *("protocol", "suite", "steps_per_second", "frames_per_second", "inference_seconds"),
    *("n_action_steps", "episodes", "seed_start", "runs", "overrides", "delay_trace", "serve"),
    *("capture_video", "capture_rrd", "capture_strip"),
)
"""Flags that a table does not take, by the names of their values; `--task` and `--policy` choose a part."""


def finetune_table(args: argparse.Namespace) -> int:
    """Fine-tune what is not finished; the folders of the checkpoints go to standard output."""
    _refuse(args, FINETUNE_FLAGS)
    study = _study(args, rows=args.policy)
    with backend_of(args, needs=lambda: needed_files(study)) as backend:
        stopped = _finetune(
            study, backend, device=args.device or "auto", allow_unreplayed=args.allow_unreplayed
        )
    if stopped is not None:
        return stopped
    for one in finetunings(study.table, study.out):
        print(one.config.out)
    return 0


def describe_table(args: argparse.Namespace) -> list[str]:
    """Return what fine-tuning the table takes, for a person: all of it, then each row on its first task."""
    from vla_eval.training.dry_run import describe_finetuning

    _refuse(args, FINETUNE_FLAGS)
    study = _study(args, rows=args.policy)
    lines = [_effort(study)]
    first: dict[str, Finetuning] = {}
    for one in finetunings(study.table, study.out):
        first.setdefault(one.row.name, one)
    with dry_run_options(args) as options:
        for name, one in first.items():
            config = replace(one.config, device=args.device or "auto", allow_unreplayed=args.allow_unreplayed)
            lines += ["", f"{name}:", *describe_finetuning(config, options)]
    return lines


def _effort(study: Study) -> str:
    n_finished = len(finetunings(study.table, study.out)) - len(unfinished(study))
    return describe_effort(study.table, n_finished=n_finished)


def evaluate_table(args: argparse.Namespace) -> int:
    """Evaluate every checkpoint and the controls, then print one table."""
    from vla_eval.cli.shared.output import check_baseline, check_table_arguments

    _refuse(args, EVAL_FLAGS)
    check_table_arguments(args)
    if args.tiny and args.dry_run:
        raise RecipeError("--tiny makes its models first: leave out --dry-run; all of it takes minutes.")
    study = _study(args, rows=args.policies)
    check_baseline(args.baseline, [*study.table.controls, *(row.name for row in study.table.rows)])
    if args.dry_run:
        print(_effort(study), f"Each is then evaluated on its task, {study.table.episodes} episodes per K.")
        return 0
    with backend_of(args, needs=lambda: needed_files(study)) as backend:
        if args.tiny:
            say(
                f"{study.table.name}: tiny random models on a stand-in for the simulator. The figures mean "
                "nothing."
            )
            record_tiny(study, backend, allow_environment_change=args.allow_environment_change)
            stopped = _finetune(study, backend, device="cpu")
            if stopped is not None:
                return stopped
        missing = unfinished(study)
        if missing:
            names = [one.name for one in missing[:3]]
            more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
            raise RecipeError(
                f"{study.table.name}: not fine-tuned to the end yet: {'; '.join(names)}{more}. "
                f"First: mikasa-vla finetune {args.config}{_part(args)} --out {study.out}"
            )
        return _evaluate(study, backend, args)


def _evaluate(study: Study, backend: Backend, args: argparse.Namespace) -> int:
    from vla_eval.cli.shared.evaluations import evaluate_each
    from vla_eval.cli.shared.output import hint_merge, print_table, write_html
    from vla_eval.storage.run_folder import read_run

    planned = []
    for folder, config in evaluations(study.table, study.out, adapters=study.adapters):
        workers = args.workers or (1 if args.tiny else config.workers)
        folder = shard_folder(folder.parent, args.shard) / folder.name
        planned.append((folder, replace(config, workers=workers)))
    with tiny_models(study):
        done = evaluate_each(planned, args, backend=backend)
    if done.stopped is not None:
        return done.stopped
    runs = [read_run(folder) for folder, _ in planned]
    print_table(runs, args)
    if args.html is not None:
        write_html(runs, args)
    if args.shard is not None:
        hint_merge(study.out / EVALUATION_FOLDER, args.shard)
    return EXIT_EPISODE_ERRORS if done.n_errors else 0


def _study(args: argparse.Namespace, *, rows: list[str] | None) -> Study:
    return open_study(
        args.config,
        tasks=args.tasks or (),
        rows=rows or (),
        out=Path(args.out) if args.out else None,
        is_tiny=getattr(args, "tiny", False),
        command=typed_command(),
    )


def _finetune(study: Study, backend: Backend, *, device: str, allow_unreplayed: bool = False) -> int | None:
    """Run all fine-tunings that are not finished; return the exit code if a signal has asked to stop."""
    from vla_eval.cli.terminal.progress import ANSWER_TO_STOP, stop_on_signals

    with stop_on_signals(ANSWER_TO_STOP) as stop, contextlib.redirect_stdout(sys.stderr):
        is_finished = finetune_study(
            study,
            backend,
            device=device,
            allow_unreplayed=allow_unreplayed,
            say=say,
            is_stopping=lambda: stop.is_asked,
        )
    return None if is_finished else stop.exit_code


def _part(args: argparse.Namespace) -> str:
    """Return the flags that choose a part of the table, as one would type them."""
    flags = (("--task", args.tasks), ("--policy", args.policies))
    return "".join(f" {flag} {' '.join(names)}" for flag, names in flags if names)


def _refuse(args: argparse.Namespace, flags: Sequence[str]) -> None:
    given = [
        "--set" if name == "overrides" else f"--{name.replace('_', '-')}"
        for name in flags
        if not ((value := getattr(args, name)) is None or value is False or value == [])
    ]
    if given:
        raise RecipeError(
            f"{', '.join(given)}: a table of learned policies sets this itself. Copy {args.config} to "
            "./configs/ and change it there."
        )
