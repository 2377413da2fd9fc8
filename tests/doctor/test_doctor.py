"""Doctor: every check says what it found, and every failure says what to do."""

import importlib.metadata
import json
import py_compile
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from vla_eval.cli.main import main
from vla_eval.doctor import CHECKS, Finding, ProbeFailure, findings, machine, packages, run_probe
from vla_eval.storage import provenance

HEALTHY: Mapping[str, Mapping[str, Any]] = {
    "cv2_build": {"version": "4.13.0", "gui": "NONE"},
    "render_devices": {"devices": ["llvmpipe"]},
    "torch_devices": {"version": "2.11.0", "cuda": None, "devices": []},
    "gpu_simulator": {"version": "1", "file": ".sapien/physx/1/x.so", "present": True},
    "episode": {"task": "T", "width": 8, "height": 8, "steps": 3, "seconds": 1.0},
}


def healthy(name: str) -> Mapping[str, Any]:
    return HEALTHY[name]


def answering(answer: Mapping[str, Any]) -> Callable[[str], Mapping[str, Any]]:
    return lambda name: answer


def broken(name: str) -> Mapping[str, Any]:
    raise ProbeFailure("crashed with SIGSEGV")


@pytest.fixture
def no_nvidia(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "nvidia_driver_version", lambda: None)


@pytest.fixture
def nvidia(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "nvidia_driver_version", lambda: "535.104.05")


@pytest.mark.usefixtures("nvidia")
@pytest.mark.parametrize("name", ["cv2", "renderer", "gpu", "gpu simulator", "episode"])
def test_a_crash_in_a_probe_is_a_finding_with_advice(name: str) -> None:
    finding = CHECKS[name](broken)
    assert finding.status in ("warn", "fail")
    assert "SIGSEGV" in finding.found
    assert finding.advice


class TestPackages:
    def test_this_environment_has_what_the_project_requires(self) -> None:
        assert packages.check_packages(healthy).status != "fail"

    @pytest.mark.parametrize(
        ("writes", "compiled", "status"),
        [(True, False, "ok"), (True, True, "ok"), (False, True, "ok"), (False, False, "warn")],
    )
    def test_a_python_that_compiles_its_imports_each_time_is_a_warning(
        self, writes: bool, compiled: bool, status: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        package = tmp_path / "largest_package"
        (package / "__pycache__").mkdir(parents=True)
        (package / "__init__.py").write_text("")
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.setattr(packages, "LARGEST", package.name)
        if compiled:
            py_compile.compile(str(package / "__init__.py"))
        monkeypatch.setattr(sys, "dont_write_bytecode", not writes)

        finding = packages.check_python(healthy)

        assert finding.status == status
        assert ("compileall" in finding.advice) == (status == "warn")

    def test_a_missing_package_and_a_version_out_of_range_are_named(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        required = ["no-such-package>=1", "numpy<1", "extra-package; extra == 'dev'"]
        monkeypatch.setattr(importlib.metadata, "requires", lambda name: required)
        finding = packages.check_packages(healthy)
        assert finding.status == "fail"
        assert "no-such-package is not installed" in finding.found
        assert f"numpy {importlib.metadata.version('numpy')} is not <1" in finding.found
        assert "extra-package" not in finding.found

    def test_versions_that_were_not_tested_are_a_warning(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "constraints.txt").write_text("# heading\nnumpy==0.0.1\nno-such-package==3\n")
        monkeypatch.setattr(packages, "PACKAGE_FOLDER", tmp_path / "vla_eval")
        finding = packages.check_packages(healthy)
        assert finding.status == "warn"
        assert "(tested: 0.0.1)" in finding.found
        assert "no-such-package" not in finding.found

    def test_a_cpu_build_counts_as_the_tested_version(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "constraints.txt").write_text("torch==2.11.0\n")
        monkeypatch.setattr(packages, "PACKAGE_FOLDER", tmp_path / "vla_eval")
        monkeypatch.setattr(packages, "package_version", lambda name: "2.11.0+cpu")
        monkeypatch.setattr(importlib.metadata, "requires", lambda name: ["torch>=2.7,<2.12"])
        assert packages.check_packages(healthy).status == "ok"

    def test_a_second_owner_of_the_package_is_a_failure(self, monkeypatch: pytest.MonkeyPatch) -> None:
        owners = {"vla_eval": ["vla-eval", "mikasa-vla-eval"], "cv2": ["opencv-python-headless"]}
        monkeypatch.setattr(importlib.metadata, "packages_distributions", lambda: owners)
        finding = packages.check_owners(healthy)
        assert finding.status == "fail"
        assert finding.found == "vla_eval belongs to mikasa-vla-eval and vla-eval"
        assert "pip uninstall vla-eval" in finding.advice

    def test_a_second_owner_of_cv2_is_a_warning(self, monkeypatch: pytest.MonkeyPatch) -> None:
        owners = {"vla_eval": ["mikasa-vla-eval"], "cv2": ["opencv-python-headless", "opencv-python"]}
        monkeypatch.setattr(importlib.metadata, "packages_distributions", lambda: owners)
        assert packages.check_owners(healthy).status == "warn"

    def test_an_opencv_with_windows_is_a_warning(self) -> None:
        finding = packages.check_cv2(answering({"version": "5.0.0", "gui": "QT5"}))
        assert (finding.status, finding.found) == ("warn", "5.0.0, user interface: QT5")


class TestVulkan:
    @pytest.fixture
    def icd(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """The only folder of driver files; empty."""
        monkeypatch.setattr(provenance, "ICD_FOLDERS", (str(tmp_path),))
        for variable in provenance.ICD_VARIABLES:
            monkeypatch.delenv(variable, raising=False)
        return tmp_path

    def check(self, monkeypatch: pytest.MonkeyPatch, *, mesa: str | None, nvidia: str | None) -> Finding:
        monkeypatch.setattr(machine, "mesa_version", lambda: mesa)
        monkeypatch.setattr(machine, "nvidia_driver_version", lambda: nvidia)
        return machine.check_vulkan(healthy)

    def test_no_driver_fails(self, icd: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        finding = self.check(monkeypatch, mesa=None, nvidia=None)
        assert finding.status == "fail"
        assert "drivers: none" in finding.found

    def test_debian_12s_own_mesa_fails(self, icd: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (icd / "lvp_icd.json").touch()
        finding = self.check(monkeypatch, mesa="22.3.6-1+deb12u1", nvidia=None)
        assert finding.status == "fail"
        assert "24.3" in finding.advice

    def test_mesa_from_backports_is_enough(self, icd: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (icd / "lvp_icd.json").touch()
        assert self.check(monkeypatch, mesa="25.0.7-2~bpo12+1", nvidia=None).status == "ok"

    def test_an_old_mesa_does_not_matter_beside_nvidias_driver(
        self, icd: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (icd / "nvidia_icd.json").touch()
        assert self.check(monkeypatch, mesa="22.3.6-1", nvidia="535.104.05").status == "ok"

    def test_a_variable_replaces_the_folders(self, icd: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (icd / "lvp_icd.json").touch()
        monkeypatch.setenv("VK_DRIVER_FILES", str(icd / "gone.json"))
        assert self.check(monkeypatch, mesa="25.0.7-2", nvidia=None).status == "fail"

    @pytest.mark.parametrize(
        ("version", "older"),
        [
            ("24.3.0-1", False),
            ("25.0.7-2~bpo12+1", False),
            ("25.2.3-1ubuntu1~24.04.1", False),
            ("1:25.0.1", False),
            ("24.2.8-1ubuntu1~24.04.1", True),
            ("22.3.6-1+deb12u1", True),
            ("9.10", True),
        ],
    )
    def test_mesa_versions_are_compared_as_numbers(self, version: str, older: bool) -> None:
        assert machine.is_older(version, "24.3") is older


class TestDevices:
    def test_a_renderer_without_device_fails(self) -> None:
        assert machine.check_renderer(answering({"devices": []})).status == "fail"

    @pytest.mark.usefixtures("no_nvidia")
    def test_a_machine_without_nvidia_needs_no_gpu(self) -> None:
        assert machine.check_gpu(healthy).status == "ok"
        assert machine.check_gpu_simulator(broken).status == "ok"

    @pytest.mark.usefixtures("nvidia")
    def test_a_driver_that_torch_cannot_use_is_a_warning(self) -> None:
        finding = machine.check_gpu(healthy)
        assert finding.status == "warn"
        assert "535.104.05" in finding.found

    @pytest.mark.usefixtures("nvidia")
    def test_a_missing_gpu_simulator_is_a_warning_that_says_where_it_belongs(self) -> None:
        answer = {"version": "105", "file": ".sapien/physx/105/lib.so", "present": False}
        finding = machine.check_gpu_simulator(answering(answer))
        assert finding.status == "warn"
        assert "~/.sapien/physx/105/lib.so" in finding.advice

    @pytest.mark.parametrize(("free_gb", "status"), [(50.0, "ok"), (1.0, "warn"), (0.1, "fail")])
    def test_a_full_disk_fails_and_a_small_one_warns(
        self, free_gb: float, status: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        usage = type("Usage", (), {"free": free_gb * 1e9})
        monkeypatch.setattr(machine.shutil, "disk_usage", lambda path: usage)
        assert machine.check_disk(healthy).status == status


class TestProbes:
    def test_a_probe_answers_from_another_process(self) -> None:
        assert set(run_probe("cv2_build")) == {"version", "gui"}

    def test_a_probe_that_raises_gives_its_last_line(self) -> None:
        with pytest.raises(ProbeFailure, match="KeyError: 'no_such_probe'"):
            run_probe("no_such_probe")

    def test_a_probe_that_crashes_is_named_by_its_signal(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        crashing = tmp_path / "python"
        crashing.write_text("#!/bin/sh\nkill -SEGV $$\n")
        crashing.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(crashing))
        with pytest.raises(ProbeFailure, match="SIGSEGV"):
            run_probe("episode")

    def test_a_probe_that_hangs_is_ended(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        hanging = tmp_path / "python"
        hanging.write_text("#!/bin/sh\nexec sleep 60\n")
        hanging.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(hanging))
        monkeypatch.setattr(findings, "PROBE_TIMEOUT_SECONDS", 0.2)
        with pytest.raises(ProbeFailure, match="no answer"):
            run_probe("episode")

    def test_what_packages_print_at_import_is_not_taken_for_the_answer(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        noisy = tmp_path / "python"
        noisy.write_text("#!/bin/sh\necho '[1mwelcome'\necho '{\"a\": 1}'\n")
        noisy.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(noisy))
        assert run_probe("episode") == {"a": 1}


class TestCommand:
    def run(self, monkeypatch: pytest.MonkeyPatch, *arguments: str, finding: Finding) -> int:
        monkeypatch.setattr("vla_eval.cli.doctor.CHECKS", {"a": lambda probe: finding, "long name": _fine})
        return main(["doctor", *arguments])

    def test_checks_are_aligned_and_a_failure_is_exit_code_1(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        code = self.run(monkeypatch, finding=Finding(status="fail", found="nothing", advice="Do it."))
        assert code == 1
        assert capsys.readouterr().out.splitlines() == [
            "fail  a          nothing",
            "                 → Do it.",
            "ok    long name  all",
        ]

    def test_a_warning_is_no_failure(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert self.run(monkeypatch, finding=Finding(status="warn", found="x", advice="y")) == 0
        assert capsys.readouterr().out.startswith("warn  a")

    def test_json_holds_the_same(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        self.run(monkeypatch, "--json", finding=Finding(status="fail", found="nothing", advice="Do it."))
        rows = json.loads(capsys.readouterr().out)
        assert rows[0] == {"check": "a", "status": "fail", "found": "nothing", "advice": "Do it."}


def _fine(probe: object) -> Finding:
    return Finding(status="ok", found="all")
