"""`mikasa-vla finetune`: fine-tune a policy on a dataset, or resume it."""

import argparse
import contextlib
import re
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_eval.cli.shared.arguments import (
    MANY,
    add_flags,
    add_old_flag,
    dry_run_options,
    memory_argument,
    positive_argument,
    read_config,
    set_flags,
    task_argument,
    typed_command,
)
from vla_eval.config.files import apply_overrides
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe
from vla_eval.config.real_robot import SIMULATED_TYPE
from vla_eval.control_modes import MOTORS
from vla_eval.errors import RecipeError
from vla_eval.evaluation.model_table import is_model_table
from vla_eval.storage.folders import check_writable
from vla_eval.strict.decoding import set_field
from vla_eval.tasks.real_stages import TWIN

if TYPE_CHECKING:
    from vla_eval.cli.terminal.progress import StopRequest
    from vla_eval.training.request import FinetuneSummary

DESCRIPTION = """Train a policy on a dataset, by the recipe in policies/NAME.yaml.

CONFIG is a file with fields `policy`, `dataset`, `out`, `run_seed`, `finetune`, `held_out`; or name
--policy and --dataset. Flags go on top of the file, --set on top of flags: it changes fields of the recipe's
`finetune` section (--set policy.chunk_size=8). The same command again resumes it exactly, also after a kill.
CONFIG may also be a table of learned policies, such as paper_vla_table: all its fine-tunings in turn, or
those of some rows (--policy) and tasks (--task).
Then: mikasa-vla eval --policy RUN --task TASK"""

EPILOG = """docs/finetuning.md explains recipes, memory and resuming. Exit codes: 0 trained to the last step;
1 a mistake; 130, 143 stopped by Ctrl-C, SIGTERM, with a checkpoint (the same command resumes)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, EPILOG
    parser.add_argument("config", nargs="?", metavar="CONFIG", help="file, or name in configs/")
    parser.add_argument(
        "--policy",
        **MANY,
        metavar="NAME",
        help="recipe in policies/ with a `finetune` section; of a table: its rows",
    )
    parser.add_argument(
        "--task", **MANY, type=task_argument, dest="tasks", metavar="T", help="of a table: its tasks"
    )
    parser.add_argument("--dataset", metavar="DIR", help="folder of one dataset, or a folder that holds one")
    parser.add_argument("--steps", type=int, metavar="N", help="gradient steps (the recipe's)")
    parser.add_argument("--batch-size", type=int, metavar="B", help="samples per step (the recipe's)")
    parser.add_argument("--run-seed", type=int, metavar="S", help="seed of weights, order and noise (0)")
    parser.add_argument("--base-checkpoint", metavar="DIR", help="weights to start from")
    parser.add_argument("--device", metavar="D", help="auto, cpu, cuda")
    parser.add_argument(
        "--held-out-every",
        type=int,
        metavar="N",
        help="evaluate a checkpoint every N steps, on held-out seeds",
    )
    parser.add_argument(
        "--held-out-episodes", type=int, metavar="E", help="episodes of each such evaluation (20)"
    )
    add_old_flag(parser, "--eval-every", "--held-out-every", kind=int)
    add_old_flag(parser, "--eval-episodes", "--held-out-episodes", kind=int)
    parser.add_argument("--out", metavar="DIR", help="run folder (runs/POLICY-DATASET-SEED)")
    parser.add_argument(
        "--allow-unreplayed", action="store_true", help="train on a dataset that no replay has confirmed"
    )
    add_flags(parser, "--cluster", "--dry-run", set="change any field of the recipe's `finetune` section")
    parser.add_argument(
        "--tflops",
        type=positive_argument,
        metavar="N",
        help="with --dry-run: rate to assume, 10^12 operations per second (100 for a GPU)",
    )
    parser.add_argument(
        "--device-memory",
        type=memory_argument,
        metavar="SIZE",
        help="with --dry-run: memory of the device, 80GB (the GPU's here)",
    )


def run(args: argparse.Namespace) -> int:
    """Fine-tune; lines for a person go to standard error, the checkpoint's folder to standard output."""
    if args.config is not None and is_model_table(args.config):
        from vla_eval.cli.shared.model_table import describe_table, finetune_table

        if args.dry_run:
            with contextlib.redirect_stdout(sys.stderr):
                lines = describe_table(args)
            print("\n".join(lines))
            return 0
        return finetune_table(args)
    if args.cluster is not None:
        raise RecipeError(
            "--cluster is for a table of learned policies, whose fine-tunings run side by side. One "
            "fine-tuning runs on this machine; on several GPUs by `accelerate launch` (docs/finetuning.md)."
        )
    config, command = _config(args), typed_command()
    if args.dry_run:
        from vla_eval.training.request import look_for, run_folder_of

        look_for(config, is_dry=True)  # before torch is imported
        check_writable(run_folder_of(config))
        from vla_eval.training.dry_run import describe_finetuning

        with contextlib.redirect_stdout(sys.stderr), dry_run_options(args) as options:
            lines = describe_finetuning(config, options)
        print("\n".join(lines))
        return 0
    summary, stop = finetune_with_progress(config, command=command)
    if stop is not None:
        print(f"Stopped at step {summary.step} in {summary.out}. To resume: {command}", file=sys.stderr)
        return stop.exit_code
    return _done(summary)


def finetune_with_progress(
    config: FinetuneConfig, *, command: str
) -> "tuple[FinetuneSummary, StopRequest | None]":
    """Fine-tune, or resume it, with lines on standard error; the request if a signal has stopped it."""
    from vla_eval.training.request import finished_run, look_for, run_folder_of

    look_for(config)
    finished = finished_run(config)
    if finished is not None:
        print(finished, file=sys.stderr)
        return finished, None
    check_writable(run_folder_of(config))
    # Here and not above: what is finished need not wait for torch.
    from vla_eval.cli.terminal.progress import ANSWER_TO_STOP, train_with_progress
    from vla_eval.training.finetune import finetune

    return train_with_progress(finetune, config, command=command, answer=ANSWER_TO_STOP)


def _done(summary: "FinetuneSummary") -> int:
    from vla_eval.checkpoints.files import read_facts
    from vla_eval.cli.shared.output import hint_next

    print(summary.checkpoint, flush=True)
    facts = read_facts(summary.checkpoint)
    tasks = [facts.task] if facts is not None and facts.task else list(facts.tasks if facts else ())
    if facts is not None and facts.control_mode == MOTORS:
        hint_next("real", "--robot", _robot_of(tasks), "--policy", summary.out)
        return 0
    hint_next("eval", "--task", *(tasks or ["TASK"]), "--policy", summary.out, "cue_blind", "oracle")
    return 0


def _robot_of(tasks: Sequence[str]) -> str:
    """Return the arm on which demonstrations of these tasks were recorded, as far as it is known."""
    is_twin = bool(tasks) and all(task.startswith(TWIN) for task in tasks)
    return SIMULATED_TYPE if is_twin else "FILE.yaml"


def _policy_paths() -> dict[str, list[str]]:
    """Return `chunk_size` -> `policy.chunk_size` of all fields of policies, for messages; without torch."""
    names = set()
    for package, pattern in (("lerobot", "policies/*"), ("vla_eval", "models/*")):
        spec = find_spec(package)
        for root in (spec.submodule_search_locations or ()) if spec else ():
            for file in Path(root).glob(f"{pattern}/configuration_*.py"):
                names |= set(re.findall(r"^    (\w+): ", file.read_text(encoding="utf-8"), re.MULTILINE))
    return {name: [f"policy.{name}"] for name in names - set(FinetuneConfig.__annotations__)}


def _config(args: argparse.Namespace) -> FinetuneConfig:
    def edit(data: dict[str, Any]) -> None:  # Any: plain data of YAML
        set_flags(data, args, ("dataset", "run_seed", "device", "out"))
        if args.policy is not None:
            if len(args.policy) > 1:
                raise RecipeError(
                    f"--policy {' '.join(args.policy)}: expected one name; several are for a table of "
                    "learned policies."
                )
            data["policy"] = args.policy[0]
        if args.allow_unreplayed:
            data["allow_unreplayed"] = True
        for path, value in (
            ("held_out.every_steps", args.held_out_every),
            ("held_out.episodes", args.held_out_episodes),
            ("finetune.steps", args.steps),
            ("finetune.batch_size", args.batch_size),
            ("finetune.base_checkpoint", args.base_checkpoint),
        ):
            if value is not None:
                set_field(FinetuneConfig, data, path, value, where="command line")
        if isinstance(data.setdefault("finetune", {}), dict):  # anything else is refused when it is decoded
            own = FinetuneRecipe.__annotations__
            asks = any(one.partition("=")[0].partition(".")[0] not in own for one in args.overrides or ())
            free = _policy_paths() if asks else {}
            apply_overrides(data["finetune"], args.overrides, cls=FinetuneRecipe, free=free)

    if args.tasks is not None:
        raise RecipeError("--task is for a table of learned policies; otherwise the dataset says the task.")
    return read_config(
        FinetuneConfig,
        edit,
        folder="configs",
        name=args.config,
        start={},
        asks="a configuration, or a policy and a dataset",
        needed={"policy": "--policy", "dataset": "--dataset"},
        example="finetune --policy act --dataset data/RememberColor3-v0 --steps 20000",
    )
