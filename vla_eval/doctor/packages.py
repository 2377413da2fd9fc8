"""Checks of Python and the installed packages."""

import importlib.metadata
import importlib.util
import sys
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import InvalidVersion, Version

from vla_eval.doctor.findings import SET_UP, Finding, Probe, ProbeFailure
from vla_eval.storage.provenance import PACKAGE_FOLDER, package_version

DISTRIBUTION = "mikasa-vla-eval"
MINIMAL_PYTHON, NEWEST_PYTHON = (3, 12), (3, 13)  # as in pyproject.toml
LARGEST = "torch"  # it takes longest to compile


def check_python(_: Probe) -> Finding:
    """Whether this is a Python that the dependencies exist for."""
    found = f"{sys.version.split()[0]}"
    if not MINIMAL_PYTHON <= sys.version_info[:2] <= NEWEST_PYTHON:
        return Finding(status="fail", found=found, advice=f"3.12 or 3.13 is needed. {SET_UP}")
    if sys.dont_write_bytecode and not _is_compiled(LARGEST):
        return Finding(
            status="warn",
            found=f"{found}, writes no compiled files",
            advice=f"Each command takes seconds longer. Unset PYTHONDONTWRITEBYTECODE, or compile once: "
            f"{sys.prefix}/bin/python -m compileall -q {sys.prefix}/lib",
        )
    return Finding(status="ok", found=found)


def _is_compiled(package: str) -> bool:
    spec = importlib.util.find_spec(package)
    return spec is None or spec.cached is None or Path(spec.cached).exists()


def check_packages(_: Probe) -> Finding:
    """Whether what pyproject.toml requires is installed, and in the versions of constraints.txt."""
    try:
        lines = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return Finding(status="fail", found=f"{DISTRIBUTION} is not installed", advice=SET_UP)
    requirements = [Requirement(line) for line in lines if "extra ==" not in line]
    wrong = [text for requirement in requirements if (text := _violation(requirement))]
    if wrong:
        return Finding(status="fail", found="; ".join(wrong), advice=SET_UP)
    # constraints.txt is only in a checkout.
    path = PACKAGE_FOLDER.parent / "constraints.txt"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    untested = []
    for package, _equals, tested in (line.partition("==") for line in lines if "==" in line):
        installed = package_version(package)
        if installed is not None and _public(installed) != _public(tested):
            untested.append(f"{package} {installed} (tested: {tested})")
    if untested:
        advice = f"These versions are allowed but were not tested together. {SET_UP}"
        return Finding(status="warn", found="; ".join(untested), advice=advice)
    return Finding(status="ok", found=f"all {len(requirements)} required packages are in range")


def check_owners(_: Probe) -> Finding:
    """Whether two distributions put files into the same package."""
    advice = {
        "vla_eval": f"Another project has the same import name: pip uninstall vla-eval, then: {SET_UP}",
        "cv2": f"Whichever was installed last wins: pip uninstall opencv-python, then: {SET_UP}",
    }
    mapping = importlib.metadata.packages_distributions()
    shared = {name: owners for name in advice if len(owners := sorted(set(mapping.get(name, ())))) > 1}
    if not shared:
        return Finding(status="ok", found="no package has two owners")
    return Finding(
        status="fail" if "vla_eval" in shared else "warn",
        found="; ".join(f"{name} belongs to {' and '.join(owners)}" for name, owners in shared.items()),
        advice=" ".join(advice[name] for name in shared),
    )


def check_cv2(probe: Probe) -> Finding:
    """Which OpenCV is imported."""
    try:
        answer = probe("cv2_build")
    except ProbeFailure as exc:
        return Finding(status="fail", found=f"cannot be imported: {exc}", advice=SET_UP)
    found = f"{answer['version']}, user interface: {answer['gui']}"
    if answer["gui"] == "NONE":
        return Finding(status="ok", found=found)
    return Finding(status="warn", found=found, advice=f"The headless one is what was tested. {SET_UP}")


def _violation(requirement: Requirement) -> str | None:
    installed = package_version(requirement.name)
    if installed is None:
        return f"{requirement.name} is not installed"
    if requirement.specifier.contains(installed, prereleases=True):
        return None
    return f"{requirement.name} {installed} is not {requirement.specifier}"


def _public(version: str) -> str:
    """Strip a label such as `+cpu`, which names a build."""
    try:
        return Version(version).public
    except InvalidVersion:
        return version
