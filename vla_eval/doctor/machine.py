"""Checks of drivers, devices and disk, and of all together: one episode."""

import re
import shutil
from ctypes.util import find_library
from pathlib import Path

from vla_eval.doctor.findings import SET_UP, Finding, Probe, ProbeFailure
from vla_eval.storage.provenance import mesa_version, nvidia_driver_version, vulkan_drivers

MINIMAL_MESA = "24.3"  # older ones lack features that SAPIEN asks for: ErrorFeatureNotPresent
LITTLE_DISK_GB, NO_DISK_GB = 5.0, 0.5  # a run with videos; a run without


def check_vulkan(_: Probe) -> Finding:
    """Whether there is a Vulkan driver that SAPIEN can render with."""
    mesa, nvidia = mesa_version(), nvidia_driver_version()
    drivers = vulkan_drivers()
    loader = find_library("vulkan") or "loader: SAPIEN's own"
    found = f"{loader}; drivers: {', '.join(drivers) or 'none'}; Mesa: {mesa or '—'}; NVIDIA: {nvidia or '—'}"
    if nvidia and any("nvidia" in name for name in drivers):
        return Finding(status="ok", found=found)
    if mesa is not None and is_older(mesa, MINIMAL_MESA):
        advice = f"SAPIEN needs Mesa {MINIMAL_MESA} or newer. {SET_UP}"
        return Finding(status="fail", found=found, advice=advice)
    if not drivers and nvidia:
        advice = "SAPIEN brings a file that names NVIDIA's driver; see below whether it works."
        return Finding(status="warn", found=found, advice=advice)
    if not drivers:
        return Finding(status="fail", found=found, advice=SET_UP)
    return Finding(status="ok", found=found)


def check_renderer(probe: Probe) -> Finding:
    """Whether SAPIEN sees a device that it can render on."""
    try:
        devices = probe("render_devices")["devices"]
    except ProbeFailure as exc:
        return Finding(status="fail", found=str(exc), advice=f"{SET_UP} See docs/install.md.")
    if devices:
        return Finding(status="ok", found="; ".join(devices))
    return Finding(status="fail", found="no device", advice=f"A Vulkan driver is missing. {SET_UP}")


def check_gpu(probe: Probe) -> Finding:
    """Whether torch can use the NVIDIA GPU, if there is one."""
    try:
        answer = probe("torch_devices")
    except ProbeFailure as exc:
        return Finding(status="fail", found=f"torch: {exc}", advice=SET_UP)
    if answer["devices"]:
        return Finding(status="ok", found=f"torch {answer['version']}: {'; '.join(answer['devices'])}")
    driver = nvidia_driver_version()
    if driver is None:
        return Finding(status="ok", found=f"torch {answer['version']}, CPU only: there is no NVIDIA driver")
    return Finding(
        status="warn",
        found=f"NVIDIA driver {driver}, but torch {answer['version']} sees no GPU (CUDA: {answer['cuda']})",
        advice="The driver may be too old for this CUDA, or torch a CPU build. See docs/install.md.",
    )


def check_gpu_simulator(probe: Probe) -> Finding:
    """Whether the library of the GPU simulator is there; SAPIEN downloads it at first use."""
    if nvidia_driver_version() is None:
        return Finding(status="ok", found="not needed: there is no NVIDIA driver")
    try:
        answer = probe("gpu_simulator")
    except ProbeFailure as exc:
        return Finding(status="warn", found=str(exc), advice="Only `sim_backend: gpu` needs it.")
    if answer["present"]:
        return Finding(status="ok", found=f"PhysX {answer['version']}")
    return Finding(
        status="warn",
        found=f"PhysX {answer['version']} for GPUs is not here; only `sim_backend: gpu` needs it",
        advice=f"SAPIEN downloads it at first use. Offline: bring ~/{answer['file']} from another machine.",
    )


def check_disk(_: Probe) -> Finding:
    """Whether results will fit where the command was started."""
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    found = f"{free_gb:.1f} GB free here"
    if free_gb >= LITTLE_DISK_GB:
        return Finding(status="ok", found=found)
    advice = "Make room, or write to another disk with --out."
    return Finding(status="fail" if free_gb < NO_DISK_GB else "warn", found=found, advice=advice)


def check_episode(probe: Probe) -> Finding:
    """Whether an image can be rendered and an episode run to its end."""
    try:
        answer = probe("episode")
    except ProbeFailure as exc:
        return Finding(status="fail", found=str(exc), advice="Fix what is said above; see docs/install.md.")
    found = "{task}: one {width}×{height} image, {steps} steps in {seconds:.1f} s".format_map(answer)
    return Finding(status="ok", found=found)


def is_older(version: str, minimum: str) -> bool:
    """Compare the leading numbers of a distribution's version with a minimum such as `24.3`."""

    def numbers(text: str) -> list[int]:
        return [int(part) for part in re.findall(r"\d+", re.split(r"[-~+]", text)[0])]

    return numbers(version.split(":")[-1]) < numbers(minimum)
