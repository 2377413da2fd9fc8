"""The flag `--cluster`: where workers, servers and fine-tunings run."""

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterator

from vla_eval.workers.backend import Backend
from vla_eval.workers.local import LOCAL
from vla_eval.workers.needed_files import Needed


@contextlib.contextmanager
def backend_of(
    args: argparse.Namespace, *, needs: Callable[[], tuple[Needed, ...]] = tuple, notes_kinds: bool = True
) -> Iterator[Backend]:
    """Give what `--cluster` names, whose machines must have the files of `needs`; else this machine."""
    if args.cluster is None:
        yield LOCAL
        return
    from vla_eval.workers.cluster.backend import cluster
    from vla_eval.workers.cluster.connect import check_address

    address = check_address(args.cluster)
    allowed = notes_kinds and bool(getattr(args, "allow_environment_change", False))
    with cluster(address, say=_say, allow_other_kind=allowed, needs=needs()) as backend:
        yield backend


def _say(line: str) -> None:
    from tqdm import tqdm

    tqdm.write(line, file=sys.stderr)
