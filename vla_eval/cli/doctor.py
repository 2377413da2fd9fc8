"""`mikasa-vla doctor`: whether this machine can evaluate, and what to do if not."""

import argparse
import dataclasses
import json

from vla_eval.doctor import CHECKS, Finding, run_probe

DESCRIPTION = """Check Python, packages, drivers and disk, render an image and run an episode. The exit
code is 1 if something is missing that evaluations need."""
EXIT_FAILED = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `doctor`."""
    parser.description = DESCRIPTION
    parser.add_argument(
        "--cluster",
        nargs="?",
        const="auto",
        metavar="WHERE",
        help="check the machines of a Ray cluster instead: auto (default), local or ray://HOST:PORT",
    )
    parser.add_argument("--json", action="store_true", help="print JSON, for programs")


def run(args: argparse.Namespace) -> int:
    """Run all checks; return 1 if one has failed."""
    if args.cluster is not None:
        return _check_cluster(args.cluster, as_json=args.json)
    findings: dict[str, Finding] = {}
    for name, check in CHECKS.items():
        findings[name] = check(run_probe)
        if not args.json:
            print(describe(name, findings[name]), flush=True)
    if args.json:
        rows = [{"check": name, **dataclasses.asdict(finding)} for name, finding in findings.items()]
        print(json.dumps(rows, indent=2, ensure_ascii=False))
    return EXIT_FAILED if any(finding.status == "fail" for finding in findings.values()) else 0


def _check_cluster(address: str, *, as_json: bool) -> int:
    """Print what each machine has, and why it cannot be used; return 1 if one cannot."""
    from vla_eval.workers.cluster.connect import check_address, connected
    from vla_eval.workers.cluster.machines import Machines

    with connected(check_address(address)) as ray:
        machines = Machines(ray)
        machines.survey()
        print(json.dumps(machines.rows(), indent=2, ensure_ascii=False) if as_json else machines.table())
        return EXIT_FAILED if any(machine.refused for machine in machines) else 0


def describe(name: str, finding: Finding) -> str:
    """Return the line of a check, and a second one with the advice if there is any."""
    width = max(map(len, CHECKS))
    line = f"{finding.status:<4}  {name:<{width}}  {finding.found}"
    return f"{line}\n{'':{width + 8}}→ {finding.advice}" if finding.advice else line
