"""`mikasa-vla finetune` and `eval` of a table of learned policies: every part that is missing."""

import argparse
import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from vla_eval.cli.arguments import EXIT_EPISODE_ERRORS, dry_run_options, typed_command
from vla_eval.cli.cluster import backend_of, shared_folder
from vla_eval.config.files import find_recipe
from vla_eval.config.shipped import search_folders
from vla_eval.errors import FolderInUseError, RecipeError
from vla_eval.evaluation.grid import (
    EVALUATION_FOLDER,
    Finetuning,
    ModelTable,
    describe_effort,
    evaluations,
    finetunings,
    load_model_table,
    narrow,
)
from vla_eval.storage.shard import shard_folder
from vla_eval.workers.backend import Backend
from vla_eval.workers.local import LOCAL
from vla_eval.workers.needed import Needed

RUNS_FOLDER = Path("runs")
FINETUNE_FLAGS = {
    "dataset": "--dataset",
    "steps": "--steps",
    "batch_size": "--batch-size",
    "run_seed": "--run-seed",
    "base_checkpoint": "--base-checkpoint",
    "held_out_every": "--held-out-every",
    "held_out_episodes": "--held-out-episodes",
    "overrides": "--set",
}
EVAL_FLAGS = {
    "protocol": "--protocol",
    "dry_run": "--dry-run",
    "steps_per_second": "--steps-per-second",
    "inference_seconds": "--inference-seconds",
    "n_action_steps": "--n-action-steps",
    "episodes": "--episodes",
    "seed_start": "--seed-start",
    "runs": "--runs",
    "overrides": "--set",
    "capture_video": "--capture-video",
    "capture_rrd": "--capture-rrd",
    "serve": "--serve",
}
"""Flags that a table does not take, by the name of their value.

`--task` and `--policy` choose a part of it.
"""


class _Work(NamedTuple):
    """A table, where it goes, and which rows have an adapter of their own."""

    table: ModelTable
    out: Path
    adapters: dict[str, str]


def finetune_table(args: argparse.Namespace) -> int:
    """Fine-tune what is not finished; the folders of the checkpoints go to standard output.

    Raises:
        VlaEvalError: a flag that a table does not take, a missing dataset, a mistake in a recipe.
    """
    _refuse(args, FINETUNE_FLAGS)
    work = _work(args, rows=args.policy)
    with backend_of(args, needs=lambda: _needs(work)) as backend:
        device = args.device or "auto"
        stopped = _finetune(work, backend, device=device, allow_unreplayed=args.allow_unreplayed)
    if stopped is not None:
        return stopped
    for one in finetunings(work.table, work.out):
        print(one.config.out)
    return 0


def describe_table(args: argparse.Namespace) -> list[str]:
    """Return what fine-tuning the table takes, for a person: all of it, then each row on its first task."""
    from vla_eval.training.dry_run import describe_finetuning

    _refuse(args, FINETUNE_FLAGS)
    work = _work(args, rows=args.policy)
    n_finished = len(finetunings(work.table, work.out)) - len(_unfinished(work))
    lines = [describe_effort(work.table, n_finished=n_finished)]
    first: dict[str, Finetuning] = {}
    for one in finetunings(work.table, work.out):
        first.setdefault(one.row.name, one)
    with dry_run_options(args) as options:
        for name, one in first.items():
            config = replace(one.config, device=args.device or "auto", allow_unreplayed=args.allow_unreplayed)
            lines += ["", f"{name}:", *describe_finetuning(config, options)]
    return lines


def evaluate_table(args: argparse.Namespace) -> int:
    """Evaluate every checkpoint and the controls, then print one table.

    Raises:
        VlaEvalError: a flag that a table does not take; a row that has not been fine-tuned.
    """
    from vla_eval.cli.output import check_baseline, check_table_arguments

    _refuse(args, EVAL_FLAGS)
    check_table_arguments(args)
    work = _work(args, rows=args.policies)
    check_baseline(args.baseline, [*work.table.controls, *(row.name for row in work.table.rows)])
    with backend_of(args, needs=lambda: _needs(work)) as backend:
        if args.tiny:
            _record_tiny(work, backend, allow_environment_change=args.allow_environment_change)
            stopped = _finetune(work, backend, device="cpu")
            if stopped is not None:
                return stopped
        _refuse_unfinished(work, args)
        return _evaluate(work, backend, args)


def _evaluate(work: _Work, backend: Backend, args: argparse.Namespace) -> int:
    from vla_eval.cli.evaluations import evaluate_each
    from vla_eval.cli.output import hint_merge, print_table, write_html
    from vla_eval.storage.run_folder import read_run

    planned = []
    for folder, config in evaluations(work.table, work.out, adapters=work.adapters):
        workers = args.workers or (1 if args.tiny else config.workers)
        folder = shard_folder(folder.parent, args.shard) / folder.name
        planned.append((folder, replace(config, workers=workers)))
    with _tiny_models(work):
        done = evaluate_each(planned, args, backend=backend)
    if done.stopped is not None:
        return done.stopped
    runs = [read_run(folder) for folder, _ in planned]
    print_table(runs, args)
    if args.html is not None:
        write_html(runs, args)
    if args.shard is not None:
        hint_merge(work.out / EVALUATION_FOLDER, args.shard)
    return EXIT_EPISODE_ERRORS if done.n_errors else 0


def _work(args: argparse.Namespace, *, rows: Sequence[str] | None) -> _Work:
    table = narrow(load_model_table(args.config), tasks=args.tasks or (), rows=rows or ())
    is_tiny = getattr(args, "tiny", False)
    out = Path(args.out) if args.out else RUNS_FOLDER / (table.name + ("_tiny" if is_tiny else ""))
    if not is_tiny:
        return _Work(table, out, {})
    from vla_eval.testing.tiny_table import tiny_table

    tiny, adapters = tiny_table(table, out)
    return _Work(tiny, out, adapters)


def _needs(work: _Work) -> tuple[Needed, ...]:
    """Return the folders that workers write into and read from, and the recipes that they read.

    Those of the package are compared anyway.
    """
    from vla_eval.policies.checkpoint import file_sha256

    found = dict.fromkeys(find_recipe("policies", row.policy) for row in work.table.rows)
    own = [path for path in found if path.parent != search_folders("policies")[-1]]
    recipes = [Needed(path=str(path), sha256=file_sha256(path), digest=file_sha256) for path in own]
    return (shared_folder(work.out), shared_folder(Path(work.table.datasets)), *recipes)


def _finetune(work: _Work, backend: Backend, *, device: str, allow_unreplayed: bool = False) -> int | None:
    """Run all fine-tunings that are not finished; leave out those that another process has begun.

    Returns:
        The exit code if a signal has asked to stop.
    """
    everything = finetunings(work.table, work.out)
    unfinished = _unfinished(work)
    _say(describe_effort(work.table, n_finished=len(everything) - len(unfinished)))
    _check(work.table, unfinished)
    todo = [
        one._replace(
            config=replace(
                one.config,
                device=device,
                allow_unreplayed=allow_unreplayed or one.config.allow_unreplayed,
            )
        )
        for one in unfinished
    ]
    if backend is LOCAL:
        return _finetune_here(work, todo)
    from vla_eval.cli.table_on_cluster import finetune_on

    finetune_on(backend, todo, logs=work.out / "logs", is_tiny=bool(work.adapters), say=_say)
    return None


def _finetune_here(work: _Work, todo: Sequence[Finetuning]) -> int | None:
    """Run one fine-tuning after the other in this process: each takes all GPUs of this machine."""
    from vla_eval.cli.progress import ANSWER_TO_STOP, stop_on_signals
    from vla_eval.training.finetune import finetune

    command = typed_command()
    with (
        stop_on_signals(ANSWER_TO_STOP) as stop,
        contextlib.redirect_stdout(sys.stderr),
        _tiny_models(work),
    ):
        for index, one in enumerate(todo):
            if _is_finished(one):
                continue
            name = f"[{index + 1}/{len(todo)}] {one.row.name} on {one.task}, run seed {one.run_seed}"
            _say(name)
            try:
                done = finetune(one.config, command=command, say=_say, is_stopping=lambda: stop.is_asked)
            except FolderInUseError:
                _say("  another process is training it")
            else:
                if not done.is_finished:
                    _say(f"{name}: stopped at step {done.step}. To resume: {command}")
                    return stop.exit_code
            _free_memory()
    return None


def _check(table: ModelTable, ahead: Sequence[Finetuning]) -> None:
    """Find missing datasets and bases now, which would otherwise stop the work after days."""
    from vla_eval.policies.checkpoint import find_checkpoint
    from vla_eval.training.request import load_finetune_recipe

    missing = [one.config.dataset for one in ahead if not Path(one.config.dataset).is_dir()]
    if missing:
        raise RecipeError(
            f"{table.name}: {', '.join(dict.fromkeys(missing))}: expected a dataset, found no folder. Record "
            f"them: mikasa-vla record --task {' '.join(table.tasks)} --out {table.datasets}"
        )
    for config in {one.row.name: one.config for one in ahead}.values():
        base = load_finetune_recipe(config).value.base_checkpoint
        if base is not None:
            find_checkpoint(Path(base))


def _unfinished(work: _Work) -> list[Finetuning]:
    return [one for one in finetunings(work.table, work.out) if not _is_finished(one)]


def _is_finished(one: Finetuning) -> bool:
    from vla_eval.training.request import load_finetune_recipe
    from vla_eval.training.run_folder import whole_checkpoints

    whole = whole_checkpoints(Path(str(one.config.out)))
    return bool(whole) and int(whole[-1].name) >= load_finetune_recipe(one.config).value.steps


def _refuse_unfinished(work: _Work, args: argparse.Namespace) -> None:
    unfinished = _unfinished(work)
    if unfinished:
        names = [f"{one.row.name} on {one.task}, run seed {one.run_seed}" for one in unfinished[:3]]
        more = f" and {len(unfinished) - 3} more" if len(unfinished) > 3 else ""
        raise RecipeError(
            f"{work.table.name}: not fine-tuned to the end yet: {'; '.join(names)}{more}. "
            f"First: mikasa-vla finetune {args.config}{_part(args)} --out {work.out}"
        )


def _part(args: argparse.Namespace) -> str:
    """Return the flags that choose a part of the table, as one would type them."""
    flags = (("--task", args.tasks), ("--policy", args.policies))
    return "".join(f" {flag} {' '.join(names)}" for flag, names in flags if names)


def _record_tiny(work: _Work, backend: Backend, *, allow_environment_change: bool) -> None:
    from vla_eval.data.recording import record
    from vla_eval.testing.tiny_table import tiny_dataset

    _say(f"{work.table.name}: tiny random models on a stand-in for the simulator. The figures mean nothing.")
    record(
        tiny_dataset(work.table),
        out=Path(work.table.datasets),
        command=typed_command(),
        allow_environment_change=allow_environment_change,
        backend=backend,
    )


@contextlib.contextmanager
def _tiny_models(work: _Work) -> Iterator[None]:
    """Build lerobot's π0 in its tiny form if the table is a tiny one."""
    if not work.adapters:
        yield
        return
    from vla_eval.testing.tiny_models import tiny_paligemma

    with tiny_paligemma("pi0"):
        yield


def _free_memory() -> None:
    """Give a GPU's memory back before the next model."""
    import gc

    import torch

    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def _refuse(args: argparse.Namespace, flags: Mapping[str, str]) -> None:
    values = {flag: getattr(args, name) for name, flag in flags.items()}
    given = [flag for flag, value in values.items() if not (value is None or value is False or value == [])]
    if given:
        raise RecipeError(
            f"{', '.join(given)}: a table of learned policies sets this itself. Copy {args.config} to "
            "./configs/ and change it there."
        )


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
