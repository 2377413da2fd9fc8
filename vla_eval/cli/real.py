"""`mikasa-vla real`: the paper's three stages on a robot arm, with an operator; or on a simulated one."""

import argparse
import sys
from typing import TYPE_CHECKING, Any

from vla_eval.cli.shared.arguments import EXIT_EPISODE_ERRORS, MANY, add_flags, typed_command
from vla_eval.cli.shared.arm import (
    KEYS,
    LEROBOT,
    SCRIPTED,
    Connecting,
    connected,
    fault_names,
    led,
    named_faults,
    named_leader,
    named_robot,
    say,
)
from vla_eval.errors import RecipeError
from vla_eval.tasks.real_stages import DEMONSTRATIONS_PER_COLOR, EPISODES_PER_COLOR, STAGES, stage_of

if TYPE_CHECKING:
    from vla_eval.cli.terminal.progress import StopRequest
    from vla_eval.real.demonstrations import Demonstrations
    from vla_eval.real.evaluation import RealEvaluation
    from vla_eval.real.recording import RecordedStages
    from vla_eval.real.session import SessionSummary

DESCRIPTION = """Run the paper's three stages on a robot arm, and print their table (docs/real_robot.md);
`real record` records demonstrations of them instead, one LeRobotDataset per stage: OUT/TASK.

ROBOT is a YAML file with LeRobot's fields of the arm and the limits of its motion, or simulated_so100, with
a scripted operator. The order of stages, colours and policies is random, and which policy moves the arm is
hidden from the operator. The same command again resumes at the next episode, and retries those
that ended in an error (a cable, a camera, a key that was let go)."""
EPILOG = """exit codes: 0 every episode has a result; 1 a mistake, or a fault that ended the session (see the
message); 3 some episodes ended in an error; 130, 143 stopped by Ctrl-C, SIGTERM."""
MAY_IT_MOVE = "Is all of this right, is the arm free, and may it move?"
EVALUATE, RECORD = "evaluate", "record"
FLAGS_OF = {EVALUATE: ("policies", "n_action_steps", "capture_video", "paper"), RECORD: ("teleop", "keep")}
"""Arguments that the other of the two does not take."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, EPILOG
    parser.add_argument(
        "what",
        nargs="?",
        choices=(EVALUATE, RECORD),
        default=EVALUATE,
        metavar="evaluate|record",
        help="what is done on the arm (evaluate)",
    )
    parser.add_argument("--robot", metavar="ROBOT", help="FILE.yaml, or simulated_so100")
    add_flags(
        parser,
        policy="names in policies/, checkpoints or ws://HOST:PORT; NAME:real_twin/STAGE-v0=DIR, several: one "
        "per stage",
        episodes=f"per stage and colour: episodes of each policy ({EPISODES_PER_COLOR}), or demonstrations "
        f"({DEMONSTRATIONS_PER_COLOR})",
    )
    parser.add_argument(
        "--operator",
        choices=(KEYS, SCRIPTED),
        help="who sets the table and marks: you, by keys; or a script (simulated_so100)",
    )
    parser.add_argument(
        "--teleop",
        choices=(LEROBOT, SCRIPTED),
        help="record: what leads the arm: `teleop` of the arm's file; or a script (simulated_so100)",
    )
    parser.add_argument(
        "--keep", choices=("successes", "all"), help="record: which episodes are kept (successes)"
    )
    names = [stage.name for stage in STAGES]
    parser.add_argument(
        "--stage", **MANY, dest="stages", default=names, metavar="S", help=f"({', '.join(names)})"
    )
    parser.add_argument("--plan-seed", type=int, default=0, metavar="S", help="of the order (0)")
    parser.add_argument(
        "--n-action-steps", type=int, metavar="K", help="actions per inference (each policy's own)"
    )
    parser.add_argument("--capture-video", action="store_true", help="an mp4 of each episode")
    parser.add_argument(
        "--paper", action="store_true", help="print the paper's figures of the same stages beside yours"
    )
    parser.add_argument(
        "--rehearse",
        **MANY,
        default=[],
        metavar="FAULT@N",
        help=f"on simulated_so100: a fault in episode N: {', '.join(fault_names())}",
    )
    add_flags(
        parser,
        "--allow-environment-change",
        out="run folder (runs/real-FINGERPRINT), or folder of the datasets (data/real-FINGERPRINT)",
        dry_run="read the arm and ask the policies once; command nothing",
    )


def run(args: argparse.Namespace) -> int:
    """Run the session, then print its result to standard output; the rest goes to standard error."""
    from vla_eval.cli.terminal.progress import stop_on_signals

    for other, names in FLAGS_OF.items():
        given = [name for name in names if not (getattr(args, name) is None or getattr(args, name) is False)]
        if other != args.what and given:
            flag = {"policies": "policy"}.get(given[0], given[0]).replace("_", "-")
            raise RecipeError(
                f"--{flag} is for `mikasa-vla real {other}`, found `{args.what}`. Leave it out."
            )
    with stop_on_signals() as stop:
        try:
            return _record(args, stop) if args.what == RECORD else _evaluate(args, stop)
        except KeyboardInterrupt:
            if not stop.is_asked:
                raise
            print(f"Stopped. To resume: {typed_command()}", file=sys.stderr)
            return stop.exit_code


def _evaluate(args: argparse.Namespace, stop: "StopRequest") -> int:
    from vla_eval.storage.run_folder import read_run

    evaluation = _evaluation(args)
    faults = named_faults(args.rehearse, evaluation.robot, n_episodes=len(evaluation.plan))
    asked = Connecting(settings=evaluation.robot, faults=faults, stops=lambda: stop.is_asked)
    summary = _session(evaluation, args, asked)
    if summary is None:
        return 0
    if summary.n_open:
        print(
            f"{summary.n_open} of {summary.n_episodes} episodes have no result yet ({summary.n_errors} ended "
            f"in an error just now); the same command runs them. Causes: {evaluation.out}/episodes.jsonl.",
            file=sys.stderr,
        )
    if summary.n_open and len(evaluation.names) > 1:
        print(
            "The table comes when all have one; until then, which policy ran stays hidden.", file=sys.stderr
        )
    else:
        _print_table(read_run(evaluation.out).records, with_paper=args.paper)
    return EXIT_EPISODE_ERRORS if summary.n_errors else 0


def _print_table(records: Any, *, with_paper: bool) -> None:  # Any: of a room that is imported late
    from vla_eval.cli.terminal.screen import print_markdown
    from vla_eval.real.table import real_table
    from vla_eval.results.printed_table import write_tables

    print_markdown(write_tables([real_table(records, with_paper=with_paper)], "markdown"))


def _evaluation(args: argparse.Namespace) -> "RealEvaluation":
    """Resolve what was asked for; nothing heavy is imported before all names are known."""
    for flag, given in (("--robot", args.robot), ("--policy", args.policies)):
        if given is None:
            raise RecipeError(
                f"Name an arm and at least one policy; {flag} is missing. Example: mikasa-vla real --robot "
                "simulated_so100 --policy oracle"
            )
    robot = named_robot(args.robot, args.operator)
    stages = tuple(dict.fromkeys(map(stage_of, args.stages)))
    from vla_eval.policies.entries import load_policy_entries
    from vla_eval.real.evaluation import RealEvaluation

    return RealEvaluation(
        robot=robot,
        policies=load_policy_entries(args.policies),
        stages=stages,
        episodes=EPISODES_PER_COLOR if args.episodes is None else args.episodes,
        seed=args.plan_seed,
        n_action_steps=args.n_action_steps,
        named_out=args.out,
    )


def _session(
    evaluation: "RealEvaluation", args: argparse.Namespace, asked: Connecting
) -> "SessionSummary | None":
    """Run the session; None for a dry run."""
    from vla_eval.config.evaluation import CaptureConfig
    from vla_eval.real.session import Session

    with connected(asked) as station:
        session = Session(
            evaluation=evaluation,
            station=station,
            say=say,
            stops=asked.stops,
            capture=CaptureConfig(video="all" if args.capture_video else "none"),
        )
        if _is_dry(args, session.dry_run(), f"{len(evaluation.plan)} episodes in {evaluation.out}."):
            return None
        station.operator.ask(MAY_IT_MOVE)
        return session.run(command=typed_command(), allow_environment_change=args.allow_environment_change)


def _is_dry(args: argparse.Namespace, lines: list[str], planned: str) -> bool:
    """Show what the dry run has found, and return whether that is all."""
    show = print if args.dry_run else say  # then it is the result
    for line in lines:
        show(line)
    if args.dry_run:
        show(f"{planned} Nothing was commanded.")
    return bool(args.dry_run)


def _record(args: argparse.Namespace, stop: "StopRequest") -> int:
    from vla_eval.cli.shared.output import hint_next

    demonstrations = _demonstrations(args)
    faults = named_faults(args.rehearse, demonstrations.robot, n_episodes=demonstrations.n_episodes)
    asked = Connecting(settings=demonstrations.robot, faults=faults, stops=lambda: stop.is_asked)
    recorded = _recording(demonstrations, args, asked)
    if recorded is None:
        return 0
    for path, facts in recorded.datasets.items():
        print(
            f"{path}: {len(facts.episodes)} episodes, {facts.n_frames} frames; discarded: {facts.n_discarded}"
        )
    hint_next("finetune", "--policy", "act", "--dataset", next(iter(recorded.datasets)))
    return 0


def _demonstrations(args: argparse.Namespace) -> "Demonstrations":
    if args.robot is None:
        raise RecipeError(
            "Name an arm; --robot is missing. Example: mikasa-vla real record --robot simulated_so100"
        )
    robot = named_robot(args.robot, args.operator)
    leader = named_leader(robot, args.teleop)
    stages = tuple(dict.fromkeys(map(stage_of, args.stages)))
    from vla_eval.real.demonstrations import Demonstrations
    from vla_eval.real.leaders import in_motors

    return Demonstrations(
        robot=in_motors(robot),
        leader=leader,
        stages=stages,
        episodes=DEMONSTRATIONS_PER_COLOR if args.episodes is None else args.episodes,
        seed=args.plan_seed,
        keep=args.keep or "successes",
        named_out=args.out,
    )


def _recording(
    demonstrations: "Demonstrations", args: argparse.Namespace, asked: Connecting
) -> "RecordedStages | None":
    """Run the recording; None for a dry run."""
    from vla_eval.real.recording import RecordingSession

    with connected(asked) as arm, led(arm) as (station, leader):
        session = RecordingSession(
            asked=demonstrations, station=station, leader=leader, say=say, stops=asked.stops
        )
        if _is_dry(
            args, session.dry_run(), f"{demonstrations.n_episodes} demonstrations in {demonstrations.out}."
        ):
            return None
        station.operator.ask(MAY_IT_MOVE)
        return session.run(command=typed_command(), allow_environment_change=args.allow_environment_change)
