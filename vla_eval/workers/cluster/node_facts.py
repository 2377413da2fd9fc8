"""What a machine of a cluster has, found on that machine; and whether it can be used with this one."""

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from vla_eval.config.files import digest_of
from vla_eval.storage.provenance import collect_environment, vulkan_drivers
from vla_eval.storage.run_file import JsonValue, find_changes
from vla_eval.workers.needed import Needed
from vla_eval.workers.start import visible_gpus

KIND_FACTS = ("cpu", "mesa", "nvidia_driver")
"""What may move the last bits of a state or a pixel while code and packages are the same."""
KIND_DIGITS = 8
MEMINFO_FILE = Path("/proc/meminfo")
LEAST_FREE_BYTES = 1 << 30  # a worker with simulator and policy has more
GB = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeFacts:
    """What there is on a machine.

    Attributes:
        environment: commit, package versions, CPU, drivers; see `collect_environment`.
        vulkan: names of its Vulkan drivers.
        free_bytes: memory that is free.
        n_gpus: GPUs with a driver.
        missing: what is wrong with the files that it was asked for.
    """

    environment: Mapping[str, JsonValue]
    vulkan: tuple[str, ...]
    free_bytes: int
    n_gpus: int
    missing: tuple[str, ...] = ()

    @property
    def kind(self) -> dict[str, JsonValue]:
        """What bits may depend on."""
        return {name: self.environment.get(name) for name in KIND_FACTS}

    @property
    def kind_name(self) -> str:
        """A short name of the kind, the same wherever the kind is the same."""
        return digest_of(self.kind)[:KIND_DIGITS]


def node_facts(needs: tuple[Needed, ...] = (), *, folder: str = ".") -> NodeFacts:
    """Return the facts of the machine that this runs on.

    Args:
        needs: which files and folders it is to have.
        folder: the planning machine's working directory.
    """
    with contextlib.chdir(folder) if Path(folder).is_dir() else contextlib.nullcontext():
        missing = tuple(wrong for need in needs if (wrong := need.objection()) is not None)
    return NodeFacts(
        environment=collect_environment(),
        vulkan=vulkan_drivers(),
        free_bytes=free_memory_bytes(),
        n_gpus=len(visible_gpus()),
        missing=missing,
    )


def free_memory_bytes() -> int:
    """Return how much memory is free, as Linux says; what it keeps of files counts as free."""
    for line in MEMINFO_FILE.read_text(encoding="utf-8").splitlines():
        name, _, rest = line.partition(":")
        if name == "MemAvailable":
            return int(rest.split()[0]) << 10
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def objections(found: NodeFacts, expected: NodeFacts, *, allow_other_kind: bool) -> tuple[str, ...]:
    """Return why a machine cannot be used; none: it can.

    Args:
        found: its facts.
        expected: those of the machine that plans.
        allow_other_kind: accept another CPU model or driver.
    """
    wrong = [str(change) for change in find_changes(_code(expected), _code(found), prefix="")]
    if not allow_other_kind and (changes := find_changes(expected.kind, found.kind, prefix="")):
        listed = "; ".join(map(str, changes))
        wrong.append(f"another kind of machine ({listed}): --allow-environment-change accepts it")
    if expected.vulkan and not found.vulkan:
        wrong.append("no Vulkan driver: `mikasa-vla doctor` there says what to install")
    if found.free_bytes < LEAST_FREE_BYTES:
        wrong.append(
            f"{found.free_bytes / GB:.1f} GB of memory are free, expected {LEAST_FREE_BYTES / GB:.1f}"
        )
    return (*wrong, *found.missing)


def _code(facts: NodeFacts) -> dict[str, JsonValue]:
    return {name: value for name, value in facts.environment.items() if name not in KIND_FACTS}
