"""The machines of a cluster as the driver sees them: which can be used, which died, which were set aside."""

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol  # Ray is optional: not looked at by mypy

from vla_eval.errors import ClusterError
from vla_eval.workers.cluster.connect import on_machine
from vla_eval.workers.cluster.node_facts import NodeFacts, node_facts, objections, receive
from vla_eval.workers.jobs import MachineKind
from vla_eval.workers.load import MachineLoad
from vla_eval.workers.needed_files import Needed
from vla_eval.workers.parcel import pack

MAX_ERRORS_IN_A_ROW = 3
CHECK_SECONDS = 120.0  # for a machine to say what it has; its first Python process may be on a cold disk
LOOK_SECONDS = 5.0  # between two looks at which machines there are
NOTE_SECONDS = 60.0  # between two notes of how fast each machine is

COLUMNS = ("machine", "address", "cores", "GPUs", "memory", "CPU", "Mesa", "NVIDIA", "recipes", "used")

logger = logging.getLogger(__name__)


class BusyService(Protocol):
    """A policy server, for its share of time in forward passes."""

    def busy_share(self) -> float | None:
        """Return it, from 0 to 1, since an earlier call; None: it is not known yet."""


@dataclass(slots=True, kw_only=True, eq=False)
class Machine:
    """One machine."""

    node: str  # its id in the cluster
    # `name`, `n_running`, `n_done`: see `MachineLoad`
    name: str
    address: str
    # `n_cores`, `n_gpus`: what the cluster may use of it
    n_cores: int
    n_gpus: int
    facts: NodeFacts | None = None  # its facts; None: it has not answered yet
    refused: tuple[str, ...] = ()  # why it is not used; empty: it is
    is_alive: bool = True  # whether the cluster has it
    was_sent: bool = False  # whether folders that it did not have were sent to it
    kind: MachineKind | None = None  # what kind it is; None: the same as the planning machine
    n_used: int = 0
    n_running: int = 0
    n_done: int = 0
    n_errors_in_a_row: int = 0  # workers that died and jobs that failed since its last answer
    services: list[BusyService] = field(default_factory=list)
    seen_at: float = field(default_factory=time.monotonic)  # `time.monotonic` when it came

    @property
    def is_usable(self) -> bool:
        """Whether workers may be started on it."""
        return self.is_alive and self.facts is not None and not self.refused

    def load(self) -> MachineLoad:
        """Return what it is doing."""
        shares = [share for service in self.services if (share := service.busy_share()) is not None]
        return MachineLoad(
            name=self.name,
            is_used=self.is_usable,
            n_workers=self.n_used,
            n_running=self.n_running,
            n_done=self.n_done,
            per_second=self.n_done / max(time.monotonic() - self.seen_at, 1e-9),
            n_gpus=self.n_gpus,
            gpu_share=sum(shares) / len(shares) if shares and self.n_gpus else None,
        )

    def n_free(self, *, takes_gpu: bool = False) -> int:
        """Return how many more workers it has room for."""
        n_places = min(self.n_cores, self.n_gpus) if takes_gpu else self.n_cores
        return n_places - self.n_used if self.is_usable else 0


class Machines:
    """All machines of the cluster that the driver is connected to; see `cluster` for the arguments."""

    def __init__(
        self,
        ray: Any,
        *,
        allow_other_kind: bool = False,
        needs: tuple[Needed, ...] = (),
        say: Callable[[str], None] = logger.warning,
    ) -> None:
        self._ray, self._allow_other_kind, self._needs, self.say = ray, allow_other_kind, needs, say
        self.here = node_facts()
        self._known: dict[str, Machine] = {}
        self._checks: dict[Any, tuple[Machine, float]] = {}
        self._looked_at = -LOOK_SECONDS
        self._noted_at = time.monotonic()

    def __iter__(self) -> Iterator[Machine]:
        """All machines that there ever were, in the order in which they came."""
        return iter(self._known.values())

    @property
    def usable(self) -> list[Machine]:
        """Those that workers may be started on."""
        return [machine for machine in self if machine.is_usable]

    def survey(self) -> None:
        """Wait until every machine has said what it has or is late; a `ClusterError` if none can be used."""
        self.look(at_once=True)
        while self._checks:
            self._ray.wait(list(self._checks), num_returns=len(self._checks), timeout=0.5)
            self._collect()
        if not any(machine.n_free() for machine in self.usable):
            raise ClusterError(f"no machine of the cluster can be used.\n{self.table()}")

    def look(self, *, at_once: bool = False) -> None:
        """Notice machines that have come or gone; with at least `LOOK_SECONDS` between two looks."""
        now = time.monotonic()
        if now - self._looked_at >= LOOK_SECONDS or at_once:
            self._looked_at = now
            nodes = {str(node["NodeID"]): node for node in self._ray.nodes()}
            for name, node in nodes.items():
                if node["Alive"] and name not in self._known:
                    machine = self._known[name] = _machine(node)
                    self._ask(machine, node_facts, self._needs)
            for machine in self:
                is_alive = machine.node in nodes and bool(nodes[machine.node]["Alive"])
                if machine.is_alive and not is_alive:
                    self.say(f"machine {machine.name} is gone; what it ran is run again elsewhere")
                machine.is_alive = is_alive
        self._collect()
        if now - self._noted_at >= NOTE_SECONDS:
            self._noted_at = now
            self.say(self.progress())

    def note_error(self, machine: Machine, what: str) -> None:
        """Count an error of a machine; one that errs again and again is set aside, unless it is the last."""
        machine.n_errors_in_a_row += 1
        if machine.n_errors_in_a_row < MAX_ERRORS_IN_A_ROW or not machine.is_usable:
            return
        if all(other is machine for other in self.usable if other.n_cores):
            return
        machine.refused = (f"set aside after {machine.n_errors_in_a_row} errors in a row: {what}",)
        self.say(f"machine {machine.name}: {machine.refused[0]}")

    def note_answer(self, machine: Machine, *, n_items: int) -> None:
        """Count what a machine has done."""
        machine.n_errors_in_a_row = 0
        machine.n_done += n_items

    def loads(self) -> tuple[MachineLoad, ...]:
        """Return what each machine that can be used, or has done something, is doing."""
        return tuple(machine.load() for machine in self if machine.n_done or machine.is_usable)

    def progress(self) -> str:
        """Return what each machine has done, for a person."""
        return "; ".join(map(_described, self.loads()))

    def rows(self) -> list[dict[str, str]]:
        """Return the table's rows: column -> text."""
        return [dict(zip(COLUMNS, _row(machine), strict=True)) for machine in self]

    def table(self) -> str:
        """Return one line per machine: what it has, and why it is not used."""
        rows = [COLUMNS, *(tuple(row.values()) for row in self.rows())]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return "\n".join(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        )

    def _ask(self, machine: Machine, task: Callable[..., NodeFacts], *args: Any) -> None:
        options = {"num_cpus": 0, "max_retries": 0, "scheduling_strategy": on_machine(machine.node)}
        ref = self._ray.remote(task).options(**options).remote(*args, folder=os.getcwd())
        self._checks[ref] = (machine, time.monotonic())

    def _send(self, machine: Machine, absent: Sequence[str]) -> None:
        """Send the folders that a machine does not have; it then says again what it has."""
        machine.was_sent = True
        folders = [pack(path) for path in reversed(absent)]  # an adapter's base before the adapter
        megabytes = sum(folder.n_bytes for folder in folders) / 1e6
        self.say(f"machine {machine.name}: sending it {', '.join(absent)} ({megabytes:.1f} MB)")
        self._ask(machine, receive, folders, self._needs)

    def _collect(self) -> None:
        if not self._checks:
            return
        ready, _ = self._ray.wait(list(self._checks), num_returns=len(self._checks), timeout=0)
        for ref in ready:
            machine, _ = self._checks.pop(ref)
            try:
                machine.facts = self._ray.get(ref)
            except self._ray.exceptions.RayError as exc:
                machine.refused = (f"it could not be asked: {_last_line(exc)}",)
                continue
            assert machine.facts is not None  # that is what the task returns
            if machine.facts.absent and not machine.was_sent:
                self._send(machine, machine.facts.absent)
                machine.facts = None
                continue
            machine.refused = objections(machine.facts, self.here, allow_other_kind=self._allow_other_kind)
            if machine.facts.kind != self.here.kind:
                machine.kind = MachineKind(name=machine.facts.kind_name, facts=machine.facts.kind)
        for ref, (machine, since) in list(self._checks.items()):
            if time.monotonic() - since > CHECK_SECONDS:
                del self._checks[ref]
                machine.refused = (f"no answer within {CHECK_SECONDS:.0f} s",)


def _machine(node: dict[str, Any]) -> Machine:
    resources = node["Resources"]
    return Machine(
        node=str(node["NodeID"]),
        name=f"{node['NodeManagerHostname']}/{str(node['NodeID'])[:6]}",
        address=str(node["NodeManagerAddress"]),
        n_cores=int(resources.get("CPU", 0)),
        n_gpus=int(resources.get("GPU", 0)),
    )


def _described(load: MachineLoad) -> str:
    workers = "1 worker" if load.n_workers == 1 else f"{load.n_workers} workers"
    gpu = "" if load.gpu_share is None else f", GPU {load.gpu_share:.0%}"
    return f"{load.name}: {workers}, {load.n_done} done, {load.per_second:.3g} per second{gpu}"


def _row(machine: Machine) -> tuple[str, ...]:
    facts = machine.facts
    kind = {} if facts is None else facts.kind
    state = "yes" if machine.is_usable else "; ".join(machine.refused) or "no answer yet"
    return (
        machine.name,
        machine.address,
        str(machine.n_cores),
        str(machine.n_gpus),
        "—" if facts is None else f"{facts.free_bytes / 1e9:.1f} GB",
        str(kind.get("cpu") or "—"),
        str(kind.get("mesa") or "—"),
        str(kind.get("nvidia_driver") or "—"),
        "—" if facts is None else facts.recipes_name,
        state if machine.is_alive else "gone",
    )


def _last_line(exc: BaseException) -> str:
    lines = [line for line in str(exc).splitlines() if line.strip()]
    return lines[-1].strip() if lines else type(exc).__name__
