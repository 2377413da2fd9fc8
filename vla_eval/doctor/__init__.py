"""Check the machine: one small function per possible problem, with advice.

`CHECKS` is the table; each function returns a `Finding` and never raises. What could crash the
process (a graphics driver, a broken package) runs in another process, by `doctor.subprocess_checks`.
"""

from collections.abc import Callable, Mapping

from vla_eval.doctor import machine, packages
from vla_eval.doctor.findings import Finding, Probe, ProbeFailure, run_probe

__all__ = ["CHECKS", "Finding", "Probe", "ProbeFailure", "run_probe"]

CHECKS: Mapping[str, Callable[[Probe], Finding]] = {
    "python": packages.check_python,
    "packages": packages.check_packages,
    "package owners": packages.check_owners,
    "cv2": packages.check_cv2,
    "vulkan": machine.check_vulkan,
    "renderer": machine.check_renderer,
    "gpu": machine.check_gpu,
    "gpu simulator": machine.check_gpu_simulator,
    "disk": machine.check_disk,
    "episode": machine.check_episode,
}
"""In the order in which a person would look: each needs most of what stands above it."""
