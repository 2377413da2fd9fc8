"""What workers are doing at the moment, for progress. Knows no job."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineLoad:
    """One machine of a cluster.

    Attributes:
        is_used: whether workers may be started on it; else it is gone, refused or set aside.
        n_running: items that its workers have been given and have not answered.
        n_done: items that they have answered.
        per_second: answered items per second since the machine was first seen.
        n_gpus: GPUs that the cluster may use.
        gpu_share: share of time, from 0 to 1, that the policy servers on its GPUs lately spent in forward
            passes; None: there is no such server, or it has not been asked yet.
    """

    name: str
    is_used: bool
    n_workers: int
    n_running: int
    n_done: int
    per_second: float
    n_gpus: int
    gpu_share: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """All workers.

    Attributes:
        n_running: items that workers have been given and have not answered.
        n_counted: what their processes have counted of these: control steps of an evaluation. None: it is not
            known, as on a cluster.
        machines: those of a cluster; none: this machine alone.
    """

    n_running: int
    n_counted: int | None = None
    machines: tuple[MachineLoad, ...] = ()
