"""`mikasa-vla check`: does a policy, or the server of one, keep its contract?"""

import argparse

from vla_eval.cli.shared.arguments import api_key_of, task_argument
from vla_eval.errors import RecipeError

URL_SCHEMES = ("ws://", "wss://")
DEFAULT_TASK = "RememberColor3-v0"
DEFAULT_TIMEOUT_SECONDS = 60.0
DESCRIPTION = """Check a policy without a simulator: shapes and values of its actions, and that the same
seed and observations give the same actions, in whatever order and company episodes are run.

POLICY is what `eval` takes: a name, the file of a recipe, the folder of a checkpoint. Or the address of a
policy server, ws://HOST:PORT, which is asked over the wire.

One line per requirement that is met."""
EPILOG = "exit codes: 0 all requirements are met; 1 one is not, or a mistake; 130 stopped by Ctrl-C."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, EPILOG
    parser.add_argument("policy", metavar="POLICY", help="name, file, folder, or ws://HOST:PORT")
    parser.add_argument(
        "--task",
        type=task_argument,
        metavar="TASK",
        help=f"whose cameras and states it gets (default: {DEFAULT_TASK})",
    )
    parser.add_argument("--api-key-env", metavar="VAR", help="of a server: variable that holds its key")
    parser.add_argument(
        "--timeout-seconds",
        type=float,
        metavar="S",
        help=f"of a server: how long a reply may take (default: {DEFAULT_TIMEOUT_SECONDS:g})",
    )


def run(args: argparse.Namespace) -> int:
    """Check; what holds goes to standard output as soon as it is known."""
    is_server = args.policy.startswith(URL_SCHEMES)
    met = _check_server(args) if is_server else _check_policy(args)
    print(f"{args.policy}: {len(met)} requirements checked, all met.")
    return 0


def _print_met(requirement: str) -> None:
    print(f"ok  {requirement}", flush=True)


def _check_server(args: argparse.Namespace) -> list[str]:
    from vla_eval.testing.check_remote import check_remote

    if args.task is not None:
        raise RecipeError("--task is for a local policy: a server says itself what it reads.")
    api_key = api_key_of(args)
    timeout_seconds = DEFAULT_TIMEOUT_SECONDS if args.timeout_seconds is None else args.timeout_seconds
    if not timeout_seconds > 0:
        raise RecipeError(f"--timeout-seconds: expected a number above 0, found {timeout_seconds:g}.")
    return check_remote(args.policy, api_key=api_key, timeout_seconds=timeout_seconds, report=_print_met)


def _check_policy(args: argparse.Namespace) -> list[str]:
    from vla_eval.cli.shared.output import say
    from vla_eval.policies.entries import load_policy_entry
    from vla_eval.testing.check_recipe import check_recipe

    if args.api_key_env is not None or args.timeout_seconds is not None:
        raise RecipeError(
            "--api-key-env and --timeout-seconds are for the address of a server, ws://HOST:PORT."
        )
    policy = load_policy_entry(args.policy)
    task = args.task or policy.task or DEFAULT_TASK
    return check_recipe(policy, task=task, report=_print_met, say=say)
