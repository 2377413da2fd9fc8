"""`mikasa-vla reproduce`: is a policy as good as was claimed?"""

import argparse
import itertools
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_eval.cli.shared.arguments import (
    EXIT_EPISODE_ERRORS,
    add_flags,
    env_paths,
    task_argument,
    typed_command,
)
from vla_eval.cli.shared.cluster import backend_of
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import apply_overrides
from vla_eval.errors import RecipeError, some_of
from vla_eval.strict.bounds import MAX_EPISODES
from vla_eval.strict.decoding import decode

if TYPE_CHECKING:
    from vla_eval.evaluation.resolve import ResolvedEvaluation
    from vla_eval.records import EpisodeRecord
    from vla_eval.results.claimed.acceptance import Acceptance, Decision
    from vla_eval.results.claimed.claims import Claimed

DESCRIPTION = """Run a policy on fresh seeds, under the conditions of a claim, until it is known whether it is
as good as was claimed: *reproduced* (it has lost less than --loss), *below the claim*, or *not decided*.

CLAIM is a run folder, a model card, a published row (`leaderboard_mikasa/MemoryVLA`; `mikasa-vla report
--published` shows them), or a number of successes, `91/100`. It is taken with its uncertainty: 20 of 20 is
not 1.00. The test may stop after each episode. The same command resumes."""
EPILOG = """exit codes: 0 reproduced; 4 below the claim; 5 not decided; 1 a mistake (see the message); 3 an
episode ended in an error before it was decided (the same command retries it). docs/reproduce.md explains the
test."""
EXIT_BELOW, EXIT_OPEN = 4, 5
EXIT_CODES = {"reproduced": 0, "below": EXIT_BELOW, "open": EXIT_OPEN}
MOST, POWER, LOSS, LEVEL = 1000, 0.8, 0.1, 0.05
SEED_START = 100_001  # above the seeds of demonstrations and of evaluations, as they begin by default
OUT = Path("runs/reproduce")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, EPILOG
    parser.add_argument("claim", metavar="CLAIM", help="run folder, published row, or K/N")
    parser.add_argument("--policy", required=True, metavar="P", help="name, file or folder")
    parser.add_argument("--task", type=task_argument, metavar="T", help="where the claim has several")
    parser.add_argument(
        "--n-action-steps", type=int, metavar="K", help="where the claim has several, or none"
    )
    parser.add_argument("--of", metavar="NAME", help="the claim's policy, in a run folder with several")
    parser.add_argument("--loss", type=float, default=LOSS, metavar="D", help=f"of the success rate ({LOSS})")
    parser.add_argument(
        "--level", type=float, default=LEVEL, metavar="A", help=f"of either wrong verdict, at most ({LEVEL})"
    )
    parser.add_argument(
        "--power", type=float, default=POWER, metavar="B", help=f"of accepting one that is as good ({POWER})"
    )
    add_flags(
        parser,
        *("--workers", "--cluster", "--json-progress", "--allow-environment-change", "--dry-run"),
        episodes=f"at most, if it takes so many ({MOST})",
        seed_start=f"seed of the first episode ({SEED_START:,})",
        out=f"({OUT})",
        set="change another field of the evaluation, for example render.wrist_mesh=simplified",
    )
    parser.add_argument("--format", choices=("markdown", "json"), default="markdown", help="(markdown)")
    parser.set_defaults(episodes=MOST, seed_start=SEED_START, workers="auto", out=OUT)


def run(args: argparse.Namespace) -> int:
    """Run the episodes that the test asks for, and print the verdict to standard output."""
    from vla_eval.evaluation.resolve import resolve
    from vla_eval.results.claimed.acceptance import Acceptance, fixed_plan, plan
    from vla_eval.results.claimed.claims import read_claim
    from vla_eval.results.claimed.written import render_decision, render_plan

    _check(args)
    claimed = read_claim(args.claim, task=args.task, n_action_steps=args.n_action_steps, of=args.of)
    test = Acceptance(claim=claimed.claim, loss=args.loss, level=args.level)
    most = plan(test, wanted_power=args.power, most=args.episodes)
    config = _config(args, claimed, episodes=most)
    at_end = fixed_plan(test, wanted_power=args.power, most=args.episodes)
    with backend_of(args) as backend:
        resolved = resolve(config, backend=backend, out=args.out)  # before a word is said
        print(render_plan(claimed, test, config, power=args.power, at_end=at_end), file=sys.stderr)
        if args.dry_run:
            return 0
        stopped, n_errors, decision = _evaluate(resolved, args, test)
    if stopped is not None:
        print(f"Stopped. To resume: {typed_command()}", file=sys.stderr)
        return stopped
    print(render_decision(decision, claimed, test, config, args.format))
    if decision.verdict == "open" and n_errors:
        return EXIT_EPISODE_ERRORS
    return EXIT_CODES[decision.verdict]


def _check(args: argparse.Namespace) -> None:
    if not 0 < args.power < 1:
        raise RecipeError(f"--power is {args.power:g}, expected a number between 0 and 1.")
    if not 1 <= args.episodes <= MAX_EPISODES:
        raise RecipeError(f"--episodes is {args.episodes}, expected 1 to {MAX_EPISODES:,}.")


def _config(args: argparse.Namespace, claimed: "Claimed", *, episodes: int) -> EvalConfig:
    """Return the evaluation: the claim's conditions, another policy, other seeds."""
    data: dict[str, Any] = {  # Any: plain data of YAML
        **claimed.settings,
        "name": "reproduce",
        "tasks": [claimed.task],
        "policies": [args.policy],
        "episodes": episodes,
        "seed_start": args.seed_start,
        "workers": args.workers,
        "stop_at_success": True,  # success once is what is claimed
    }
    if claimed.n_action_steps is not None:
        data["n_action_steps"] = [claimed.n_action_steps]
    apply_overrides(data, args.overrides, cls=EvalConfig, free=env_paths(args.overrides))
    config = decode(EvalConfig, data, where="reproduce")
    for name in ("tasks", "policies", "n_action_steps"):
        if len(values := getattr(config, name) or ("default",)) > 1:
            raise RecipeError(f"--set {name}: a claim is of one, found {some_of(values)}.")
    if config.runs > 1:
        raise RecipeError(f"--set runs={config.runs}: the test is of one run. Leave it out.")
    last = config.seed_start + config.episodes - 1
    known = sorted(seed for seed in claimed.seeds if config.seed_start <= seed <= last)
    if known:
        raise RecipeError(
            f"--seed-start is {config.seed_start}: expected seeds that are not the claim's, found {known[0]} "
            f"in both. Use --seed-start {max(claimed.seeds) + 1}."
        )
    return config


def _evaluate(
    resolved: "ResolvedEvaluation", args: argparse.Namespace, test: "Acceptance"
) -> "tuple[int | None, int, Decision]":
    """Run until it is decided; return the exit code if a signal came, the number of errors, the verdict."""
    from vla_eval.cli.terminal.progress import evaluate_with_progress, stop_on_signals
    from vla_eval.results.claimed.acceptance import decide
    from vla_eval.storage.folders import RUN, kind_of
    from vla_eval.storage.run_folder import read_run

    def decision() -> "Decision":
        return decide(test, outcomes(records.values(), seed_start=resolved.config.seed_start))

    def is_enough(record: "EpisodeRecord | None") -> bool:
        if record is not None:
            records[record.seed] = record
        return decision().verdict != "open"

    is_there = kind_of(resolved.out) == RUN
    # Whether they are of this policy, the evaluation finds out when it opens the folder.
    records = {one.seed: one for one in read_run(resolved.out).records} if is_there else {}
    with stop_on_signals() as stop:
        summary = evaluate_with_progress(
            resolved,
            command=typed_command(),
            stop=stop,
            allow_environment_change=args.allow_environment_change,
            json_progress=args.json_progress,
            is_enough=is_enough,
        )
    return stop.exit_code if stop.is_asked else None, summary.n_errors, decision()


def outcomes(records: "Iterable[EpisodeRecord]", *, seed_start: int) -> list[bool]:
    """Return whether each episode succeeded, seed by seed, up to the first that has no result."""
    by_seed = {record.seed: record.outcome for record in records}
    found: list[bool] = []
    for seed in itertools.count(seed_start):
        if by_seed.get(seed) not in ("success", "failure"):
            return found
        found.append(by_seed[seed] == "success")
    raise AssertionError  # seeds have no end
