"""`mikasa-vla serve`: one policy for many simulators, over WebSocket."""

import argparse
import ipaddress
import logging
import os
import sys
from typing import TYPE_CHECKING, Any

from vla_eval.cli.shared.arguments import api_key_of, task_argument
from vla_eval.errors import MAX_SHOWN, RecipeError, unknown_name
from vla_eval.strict.devices import check_device
from vla_eval.workers.start import WORKER_ENVIRONMENT

if TYPE_CHECKING:
    from vla_eval.chunking import ChunkingSettings
    from vla_eval.policies.compiled import Compilation

DESCRIPTION = """Serve a policy over WebSocket, until Ctrl-C or SIGTERM. `mikasa-vla eval --policy ws://HOST:PORT`
evaluates it, and openpi's own client gets chunks from it. Requests of several clients share a pass of the
network; an answer does not depend on who else is there."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = DESCRIPTION
    parser.add_argument(
        "--policy", required=True, metavar="P", help="name in policies/, file, or folder of a checkpoint"
    )
    parser.add_argument("--host", default="127.0.0.1", metavar="H", help="address to listen on (127.0.0.1)")
    parser.add_argument("--port", type=int, default=8000, metavar="N", help="TCP port; 0: a free one (8000)")
    parser.add_argument(
        "--max-batch", type=int, default=16, metavar="B", help="rows of a pass of the network (16)"
    )
    parser.add_argument(
        "--api-key-env", metavar="VAR", help="environment variable with the key that clients must send"
    )
    parser.add_argument(
        "--idle-seconds",
        type=float,
        default=600.0,
        metavar="S",
        help="drop sessions without a message for so long (600)",
    )
    parser.add_argument(
        "--task", type=task_argument, metavar="T", help="for policies that depend on the task"
    )
    parser.add_argument(
        "--n-action-steps", type=int, metavar="K", help="for scripted policies: actions of a chunk (1)"
    )
    parser.add_argument(
        "--device", type=check_device, metavar="D", help="auto, cpu, cuda, cuda:1 (the recipe's)"
    )
    parser.add_argument("--compile", action="store_true", help="compile its network first (docs/serve.md)")
    parser.add_argument(
        "--chunking-mode", metavar="M", help="rtc, prefix: chunks join what the client says is committed"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="rtc.FIELD=VALUE",
        help="with rtc: a field of chunking.rtc (docs/real_time.md)",
    )
    parser.add_argument("--debug", action="store_true", help="send errors with their traceback")


def run(args: argparse.Namespace) -> int:
    """Serve; print the address when clients can connect."""
    # One thread, as in workers: the sums of a pass of several rows depend on the number of threads.
    for name, value in WORKER_ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    # Here and not above: `mikasa-vla --help` need not wait for torch, which reads the number of threads.
    from vla_eval.lock.switch import let_resolve
    from vla_eval.serving.host import HostOptions, host_policy

    let_resolve(args.host)
    from vla_eval.serving.server import ServerOptions, run_server

    options = ServerOptions(
        host=args.host,
        port=args.port,
        api_key=api_key_of(args),
        idle_seconds=args.idle_seconds,
        debug=args.debug,
    )
    if options.api_key is None and not _is_loopback(args.host):
        print(
            f"warning: {args.host:.{MAX_SHOWN}} can be reached from other machines, and no key is asked for "
            "(--api-key-env).",
            file=sys.stderr,
        )
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    logging.getLogger("vla_eval.serving").setLevel(logging.INFO)
    hosted = host_policy(
        HostOptions(
            policy=args.policy,
            task=args.task,
            n_action_steps=args.n_action_steps,
            max_batch=args.max_batch,
            device=args.device,
            compile=args.compile,
            chunking=_chunking(args),
        )
    )
    for line in hosted.ignored:
        print(f"warning: {line}", file=sys.stderr)
    host = f"[{args.host}]" if ":" in args.host else args.host

    def ready(port: int, found: "Compilation | None") -> None:
        if found is not None:
            print(f"{found.note(hosted.metadata.name or args.policy)}. That took {found.seconds:.0f} s.")
        print(f"Serving {hosted.metadata.name} at ws://{host}:{port}", flush=True)

    run_server(hosted, options, ready=ready)
    return 0


def _chunking(args: argparse.Namespace) -> "ChunkingSettings":
    from vla_eval.chunking import EXECUTIONS, ChunkingSettings
    from vla_eval.config.files import apply_overrides
    from vla_eval.strict.decoding import decode

    modes = [name for name, execution in EXECUTIONS.items() if execution.commits]
    data: dict[str, Any] = {}  # Any: plain data
    if args.chunking_mode is not None:
        if args.chunking_mode not in modes:
            raise unknown_name("chunking mode", args.chunking_mode, modes, where="--chunking-mode")
        data["mode"] = args.chunking_mode
    apply_overrides(data, args.overrides, cls=ChunkingSettings)
    if data.keys() - {"mode", "rtc"} or ("rtc" in data and data.get("mode") != "rtc"):
        raise RecipeError(
            "--set: expected fields of rtc, with --chunking-mode rtc; all else is the client's."
        )
    return decode(ChunkingSettings, data, where="serve")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
