"""`mikasa-vla train-agent`: train an agent by rewards, or resume its training."""

import argparse
import contextlib
import copy
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_eval.cli.shared.arguments import (
    MANY,
    NUMBERS,
    add_flags,
    env_paths,
    read_config,
    set_flags,
    task_argument,
    typed_command,
)
from vla_eval.config.agents import AgentConfig, AgentRecipe, AgentTable, is_agent_table
from vla_eval.config.files import apply_overrides
from vla_eval.errors import RecipeError
from vla_eval.storage.folders import check_writable
from vla_eval.strict.decoding import set_field

if TYPE_CHECKING:
    from vla_eval.cli.terminal.progress import StopRequest
    from vla_eval.training.request import FinetuneSummary

DESCRIPTION = """Train an agent by rewards (PPO, PPO-LSTM, SAC: stable-baselines3) or by imitation.

--algorithm takes the recipe of that name that fits the task; --policy NAME takes another one in policies/
with a `train_agent` section, for example ppo_published. CONFIG is a file with fields `policy`, `task`,
`out`, `run_seed`, `train_agent`, `held_out`, or of several trainings, with `policies`, `tasks`,
`run_seeds`, such as base_table. --set changes a field of the recipe's section
(--set arguments.gamma=0.9). Several algorithms, tasks or run seeds are trained one after another (with
--shard beside each other), and evaluated together. The same command again resumes it exactly, also after a
kill, from the last checkpoint. Then: mikasa-vla eval --policy RUN --task TASK"""

EPILOG = """docs/agents.md explains recipes, observations, resuming. Exit codes: 0 trained to the last step;
1 a mistake; 130, 143 stopped by Ctrl-C, SIGTERM (the same command resumes from the last checkpoint)."""
ANSWER_TO_STOP = "Stopping. What came after the last checkpoint will be trained again."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, EPILOG
    parser.add_argument("config", nargs="?", metavar="CONFIG", help="file, or name in configs/")
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--algorithm", **MANY, dest="algorithms", metavar="A", help="ppo, ppo_lstm, sac, imitation"
    )
    which.add_argument(
        "--policy",
        **MANY,
        dest="policies",
        metavar="NAME",
        help="recipe in policies/ with a `train_agent` section",
    )
    parser.add_argument("--task", **MANY, type=task_argument, dest="tasks", metavar="T", help="task ids")
    parser.add_argument(
        "--observation",
        metavar="O",
        help="state (with the answer), vector (what is in view), rgb_joints; image (MIKASA-Base)",
    )
    parser.add_argument("--reward", metavar="R", help="dense, sparse (the recipe's)")
    parser.add_argument(
        "--steps",
        type=int,
        metavar="N",
        help="control steps of all environments; of an imitation, gradient steps (the recipe's)",
    )
    parser.add_argument("--n-envs", type=int, metavar="E", help="environments side by side (the recipe's)")
    parser.add_argument(
        "--run-seed",
        **NUMBERS,
        dest="run_seeds",
        metavar="S",
        help="seeds of weights, exploration and episodes (0)",
    )
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
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="run folder (runs/POLICY-TASK-SEED); of several: their folder (runs/agents)",
    )
    add_flags(
        parser,
        *("--workers", "--dry-run"),
        shard="of several trainings, only every N-th from the I-th on",
        set="change any field of the recipe's `train_agent` section",
    )


def run(args: argparse.Namespace) -> int:
    """Train; lines for a person go to standard error, checkpoints' folders to standard output."""
    configs, command = _configs(args), typed_command()
    if len(configs) > 1:
        return _run_several(args, configs, command)
    if args.shard is not None:
        raise RecipeError("--shard is for several trainings; this is one. Leave it out.")
    (config,) = configs
    if args.dry_run:
        _describe(config)
        return 0
    summary, stop = _train(config, command=command)
    if stop is not None:
        return _stopped(summary, stop, command)
    from vla_eval.cli.shared.folders import agent_evaluation
    from vla_eval.cli.shared.output import hint_next

    print(summary.checkpoint, flush=True)
    hint_next(*agent_evaluation(summary.out) or ())
    return 0


def _describe(config: AgentConfig) -> None:
    from vla_eval.agents.request import look_for

    look_for(config)
    from vla_eval.agents.dry_run import describe_training

    with contextlib.redirect_stdout(sys.stderr):
        lines = describe_training(config)
    print("\n".join(lines))


def _run_several(args: argparse.Namespace, configs: list[AgentConfig], command: str) -> int:
    from vla_eval.agents.several import in_folders, of_shard, write_evaluation
    from vla_eval.cli.shared.output import hint_next

    out = Path(args.out or "runs/agents")
    placed = in_folders(configs, out)
    own = of_shard(placed, args.shard)
    if args.dry_run:
        # Run seeds take as long as each other.
        once = {(one.policy, one.label, one.task): one for one in reversed(own)}
        for one in reversed(once.values()):
            _describe(one)
        print(f"trainings: {len(own)}, of which {len(once)} are described, one per recipe and task")
        return 0
    for number, one in enumerate(own, 1):
        print(f"training {number} of {len(own)}: {one.out}", file=sys.stderr)
        summary, stop = _train(one, command=command)
        if stop is not None:
            return _stopped(summary, stop, command)
        print(summary.checkpoint, flush=True)
    hint_next("eval", write_evaluation(placed, out), "--out", out / "evaluation")
    return 0


def _stopped(summary: "FinetuneSummary", stop: "StopRequest", command: str) -> int:
    print(f"Stopped; step {summary.step:,} is saved in {summary.out}. To resume: {command}", file=sys.stderr)
    return stop.exit_code


def _train(config: AgentConfig, *, command: str) -> "tuple[FinetuneSummary, StopRequest | None]":
    from vla_eval.agents.request import look_for, run_folder_of

    finished = look_for(config)
    if finished is not None:
        print(finished, file=sys.stderr)
        return finished, None
    check_writable(run_folder_of(config))
    # Here and not above: what is finished need not wait for torch.
    from vla_eval.agents.train import train_agent
    from vla_eval.cli.terminal.progress import train_with_progress

    return train_with_progress(train_agent, config, command=command, answer=ANSWER_TO_STOP)


def _configs(args: argparse.Namespace) -> list[AgentConfig]:
    """Return a training for each recipe, task and run seed."""
    table = _table(args.config)
    named = args.algorithms or args.policies or ([None] if table is None else table.policies)
    tasks = args.tasks or ([None] if table is None else table.tasks)
    run_seeds = args.run_seeds or ([None] if table is None else table.run_seeds)
    variants: list[str | None] = [None] if table is None else [*table.variants] or [None]
    return [
        _config(args, name, task, run_seed, start=None if table is None else table.of(task, variant))
        for name in named
        for variant in variants
        for task in tasks
        for run_seed in run_seeds
    ]


def _table(name: str | None) -> AgentTable | None:
    """Return the file if it is one of several trainings."""
    from vla_eval.tasks.configured import read_configured

    if name is None or not is_agent_table(name):
        return None
    return read_configured(AgentTable, name, folder="configs")


def _config(
    args: argparse.Namespace,
    name: str | None,
    task: str | None,
    run_seed: int | None,
    *,
    start: dict[str, Any] | None,  # Any: plain data; what all trainings of a file have
) -> AgentConfig:
    def edit(data: dict[str, Any]) -> None:  # Any: plain data of YAML
        set_flags(data, args, ("device", "out", "workers"))
        for path, value in (
            ("task", task),
            ("run_seed", run_seed),
            ("policy", None if args.algorithms else name),
            ("held_out.every_steps", args.held_out_every),
            ("held_out.episodes", args.held_out_episodes),
            ("train_agent.observation", args.observation),
            ("train_agent.reward", args.reward),
            ("train_agent.steps", args.steps),
            ("train_agent.n_envs", args.n_envs),
        ):
            if value is not None:
                set_field(AgentConfig, data, path, value, where="command line")
        section = data.setdefault("train_agent", {})
        if isinstance(section, dict):  # anything else is refused when it is decoded
            apply_overrides(section, args.overrides, cls=AgentRecipe, free=env_paths(args.overrides))
        if args.algorithms and name is not None and "task" in data:
            data["policy"] = _recipe_of(name, data["task"])

    return read_config(
        AgentConfig,
        edit,
        folder="configs",
        name=args.config if start is None else None,
        start=copy.deepcopy(start or {}),
        asks="a configuration, or an algorithm and a task",
        needed={"task": "--task", "policy": "--algorithm"},
        example="train-agent --algorithm ppo_lstm --task mikasa_base/RepeatFirstEasy-v0",
    )


def _recipe_of(name: str, task: object) -> str:
    """Return the recipe that is meant by an algorithm on a task."""
    from vla_eval.policies.agents.algorithms import algorithm
    from vla_eval.tasks.catalog import task_spec

    if not isinstance(task, str):
        raise RecipeError(f"task: expected text, found {task!r:.80}.")
    return algorithm(name).recipes["base" if task_spec(task).is_base else "robot"]
