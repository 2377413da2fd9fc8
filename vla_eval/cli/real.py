"""`mikasa-vla real`: the paper's three stages on a robot arm, with an operator; or on a simulated one."""

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from vla_eval.cli.shared.arguments import EXIT_EPISODE_ERRORS, MANY, add_flags, typed_command
from vla_eval.config.real_robot import RobotSettings, load_robot
from vla_eval.errors import RecipeError, check_names
from vla_eval.tasks.real_stages import EPISODES_PER_COLOR, STAGES, stage_of

if TYPE_CHECKING:
    from vla_eval.envs.robot.operators import Operator
    from vla_eval.envs.robot.robot_env import Station
    from vla_eval.real.evaluation import RealEvaluation
    from vla_eval.real.session import SessionSummary

DESCRIPTION = """Run the paper's three stages on a robot arm, and print their table (docs/real_robot.md).

ROBOT is a YAML file with LeRobot's fields of the arm and the limits of its motion, or simulated_so100, with
a scripted operator. The order of stages, colours and policies is random, and which policy moves the arm is
hidden from the operator. The same command again resumes at the next episode, and retries those
that ended in an error (a cable, a camera, a key that was let go)."""
EPILOG = """exit codes: 0 every episode has a result; 1 a mistake, or a fault that ended the session (see the
message); 3 some episodes ended in an error; 130, 143 stopped by Ctrl-C, SIGTERM."""
KEYS, SCRIPTED = "keys", "scripted"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, EPILOG
    parser.add_argument("--robot", metavar="ROBOT", help="FILE.yaml, or simulated_so100")
    add_flags(
        parser,
        policy="names in policies/, checkpoints or ws://HOST:PORT; NAME:real_twin/STAGE-v0=DIR, several: one "
        "per stage",
        episodes=f"episodes per stage, colour and policy ({EPISODES_PER_COLOR})",
    )
    parser.add_argument(
        "--operator",
        choices=(KEYS, SCRIPTED),
        help="who sets the table and marks: you, by keys; or a script (simulated_so100)",
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
        help="on simulated_so100: a fault in episode N: cable, power, camera, key, away",
    )
    add_flags(
        parser,
        "--allow-environment-change",
        out="run folder (runs/real-FINGERPRINT)",
        dry_run="read the arm and ask the policies once; command nothing",
    )
    parser.set_defaults(episodes=EPISODES_PER_COLOR)


def run(args: argparse.Namespace) -> int:
    """Run the session, then print the table to standard output; everything else goes to standard error."""
    from vla_eval.cli.terminal.progress import stop_on_signals
    from vla_eval.storage.run_folder import read_run

    evaluation = _evaluation(args)
    faults = _faults(args.rehearse, evaluation.robot, n_episodes=len(evaluation.plan))
    with stop_on_signals() as stop:
        try:
            summary = _session(evaluation, args, faults, stops=lambda: stop.is_asked)
        except KeyboardInterrupt:
            if not stop.is_asked:
                raise
            print(f"Stopped. To resume: {typed_command()}", file=sys.stderr)
            return stop.exit_code
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
    robot = load_robot(args.robot)
    operator = args.operator or (SCRIPTED if robot.is_simulated else KEYS)
    if (operator == SCRIPTED) != robot.is_simulated:
        raise RecipeError(
            f"--operator {operator}: a script sets the table of the simulated arm (--robot simulated_so100), "
            "and a person that of a real one. Leave --operator out."
        )
    stages = tuple(dict.fromkeys(map(stage_of, args.stages)))
    from vla_eval.policies.entries import load_policy_entries
    from vla_eval.real.evaluation import RealEvaluation

    return RealEvaluation(
        robot=robot,
        policies=load_policy_entries(args.policies),
        stages=stages,
        episodes=args.episodes,
        seed=args.plan_seed,
        n_action_steps=args.n_action_steps,
        named_out=args.out,
    )


def _faults(texts: list[str], robot: RobotSettings, *, n_episodes: int) -> dict[int, str]:
    """Return number of an episode -> fault."""
    if texts and not robot.is_simulated:
        raise RecipeError("--rehearse: expected --robot simulated_so100: a real arm has faults of its own.")
    found = {}
    for text in texts:
        kind, _, number = text.partition("@")
        check_names("fault", [kind], _fault_names(), where="--rehearse")
        if not (number.isascii() and number.isdigit() and 1 <= int(number) <= n_episodes):
            raise RecipeError(
                f"--rehearse {text:.200}: expected FAULT@N with an episode from 1 to {n_episodes}, for "
                "example cable@2."
            )
        found[int(number)] = kind
    return found


def _session(
    evaluation: "RealEvaluation",
    args: argparse.Namespace,
    faults: dict[int, str],
    *,
    stops: Callable[[], bool],
) -> "SessionSummary | None":
    """Run the session; None for a dry run."""
    from vla_eval.config.evaluation import CaptureConfig
    from vla_eval.real.session import Session

    with _connected(evaluation.robot, faults, stops) as station:
        session = Session(
            evaluation=evaluation,
            station=station,
            say=_say,
            stops=stops,
            capture=CaptureConfig(video="all" if args.capture_video else "none"),
        )
        show = print if args.dry_run else _say  # then it is the result
        for line in session.dry_run():
            show(line)
        if args.dry_run:
            show(f"{len(evaluation.plan)} episodes in {evaluation.out}. Nothing was commanded.")
            return None
        station.operator.ask("Is all of this right, is the arm free, and may it move?")
        return session.run(command=typed_command(), allow_environment_change=args.allow_environment_change)


@contextmanager
def _connected(
    settings: RobotSettings, faults: dict[int, str], stops: Callable[[], bool]
) -> "Iterator[Station]":
    """Connect the arm, and have somebody beside it."""
    from vla_eval.envs.robot.link import RobotLink
    from vla_eval.envs.robot.opening import open_robot
    from vla_eval.envs.robot.robot_env import Station
    from vla_eval.envs.robot.units import Units
    from vla_eval.envs.robot.watch import StepClock, WallClock

    with ExitStack() as ending:
        device = open_robot(settings)
        link = RobotLink(device)
        Units.of(settings, link.motors)  # refuses limits of motors that are not there, before it connects
        clock = StepClock() if settings.is_simulated else WallClock()
        operator = _operator(settings, device, faults, clock, stops, ending)
        ending.callback(link.disconnect)
        link.connect()
        yield Station.beside(link, operator, settings, clock)


def _operator(
    settings: RobotSettings,
    device: Any,
    faults: dict[int, str],
    clock: Any,
    stops: Callable[[], bool],
    ending: ExitStack,
) -> "Operator":  # Any: a robot of lerobot's, and a clock
    if settings.is_simulated:
        from vla_eval.envs.robot.scripted import ScriptedOperator

        device.faults.update(faults)
        ending.callback(device.close)
        return ScriptedOperator(device)
    from vla_eval.envs.robot.keys import KeysOperator

    terminal = sys.stdin.fileno()
    return ending.enter_context(KeysOperator(settings, clock, descriptor=terminal, say=_say, stops=stops))


def _fault_names() -> tuple[str, ...]:
    from vla_eval.envs.robot.faults import FAULTS

    return tuple(FAULTS)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
