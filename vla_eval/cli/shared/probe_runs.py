"""Run the evaluations of a probe one after another, each in a folder of its own."""

import argparse
from collections.abc import Sequence

from vla_eval.cli.shared.arguments import EXIT_EPISODE_ERRORS
from vla_eval.cli.shared.cluster import backend_of
from vla_eval.config.evaluation import EvalConfig
from vla_eval.storage.shard import shard_folder
from vla_eval.workers.needed_files import Needed


def run_all(configs: Sequence[EvalConfig], args: argparse.Namespace) -> int | None:
    """Run or resume each evaluation in `OUT/NAME`, or one shard of each, on `--cluster`.

    Returns:
        None once all are there; the exit code after a shard, or if a signal has stopped them.

    Raises:
        VlaEvalError: as for `evaluate`.
    """
    from vla_eval.cli.shared.evaluations import evaluate_each
    from vla_eval.cli.shared.output import print_shard

    out = shard_folder(args.out, args.shard)
    runs = ((out / config.name, config) for config in configs)
    with backend_of(args, needs=lambda: _needed(configs)) as backend:
        done = evaluate_each(runs, args, backend=backend)
    if done.stopped is not None:
        return done.stopped
    if args.shard is None:
        return None
    print_shard(out, args.out, args.shard)
    return EXIT_EPISODE_ERRORS if done.n_errors else 0


def _needed(configs: Sequence[EvalConfig]) -> tuple[Needed, ...]:
    from vla_eval.evaluation.needed_files import needed_files
    from vla_eval.policies.entries import load_policy_entries

    policies = dict.fromkeys(policy for config in configs for policy in config.policies)
    return needed_files(load_policy_entries(tuple(policies)))
