"""Set-up: what it takes from the machine, what it asks an administrator for, and when it does nothing.

The functions of the scripts are sourced and called; what they ask of the system is replaced by shell
functions, so nothing is installed here.
"""

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted((ROOT / "scripts").glob("*.sh"))
MIRROR = "http://mirror.example/debian"

BOOKWORM = "ID=debian\nVERSION_ID=12\nVERSION_CODENAME=bookworm\n"
NOBLE = "ID=ubuntu\nVERSION_ID=24.04\nVERSION_CODENAME=noble\n"
TRIXIE = "ID=debian\nVERSION_ID=13\nVERSION_CODENAME=trixie\n"

# An ordinary user on a machine that lacks a driver, where calling the real apt-get would be a mistake.
USER_WITHOUT_DRIVER = """
id() { echo 1000; }
has_vulkan_driver() { return 1; }
has_library() { return 0; }
is_usable_venv() { return 0; }
apt-get() { echo 'apt-get was called'; }
"""


def shell(
    script: str, *, apt: Path | None = None, release: Path | None = None, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Source set-up and run a script, with another /etc/apt and /etc/os-release."""
    environment = {
        "PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin",
        "HOME": "/nonexistent",
        **variables,
    }
    if apt is not None:
        environment["APT_ETC"] = str(apt)
    if release is not None:
        environment["OS_RELEASE"] = str(release)
    command = ["bash", "-c", f"source scripts/setup.sh\n{script}"]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)


@pytest.fixture
def apt(tmp_path: Path) -> Path:
    """An empty /etc/apt."""
    (tmp_path / "apt" / "sources.list.d").mkdir(parents=True)
    return tmp_path / "apt"


def os_release(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "os-release"
    path.write_text(text)
    return path


@pytest.mark.parametrize("script", [*SCRIPTS, ROOT / ".ci" / "run"], ids=lambda path: path.name)
def test_scripts_are_valid_bash(script: Path) -> None:
    assert subprocess.run(["bash", "-n", str(script)], capture_output=True).returncode == 0


class TestMirror:
    def source(self, apt: Path) -> str:
        done = shell("backports_source bookworm", apt=apt)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def test_mirror_and_keyring_come_from_the_deb822_entry_of_the_suite(self, apt: Path) -> None:
        (apt / "sources.list.d" / "debian.sources").write_text(
            f"Types: deb\nURIs: {MIRROR}-security\nSuites: bookworm-security\nComponents: main\n\n"
            f"Types: deb deb-src\n# a remark\nURIs: {MIRROR}\nSuites: bookworm bookworm-updates\n"
            f"Components: main contrib\nSigned-By: /usr/share/keyrings/k.gpg\n"
        )
        assert self.source(apt) == (
            f"sources\nTypes: deb\nURIs: {MIRROR}\nSuites: bookworm-backports\nComponents: main\n"
            f"Signed-By: /usr/share/keyrings/k.gpg\n"
        )

    def test_a_key_inside_a_deb822_entry_is_kept(self, apt: Path) -> None:
        key = "Signed-By:\n -----BEGIN PGP PUBLIC KEY BLOCK-----\n .\n abc=\n"
        (apt / "sources.list.d" / "debian.sources").write_text(
            f"Types: deb\nURIs: {MIRROR}\nSuites: bookworm\nComponents: main\n{key}"
        )
        assert self.source(apt).endswith(key)

    def test_an_entry_that_is_switched_off_is_not_used(self, apt: Path) -> None:
        entry = "Types: deb\nURIs: {}\nSuites: bookworm\nComponents: main\n"
        (apt / "sources.list.d" / "a.sources").write_text(
            "Enabled: no\n" + entry.format("http://off.example")
        )
        (apt / "sources.list.d" / "b.sources").write_text("Enabled: yes\n" + entry.format(MIRROR))
        assert f"URIs: {MIRROR}\n" in self.source(apt)

    def test_mirror_and_keyring_come_from_the_one_line_entry_of_the_suite(self, apt: Path) -> None:
        (apt / "sources.list").write_text(
            "# deb http://remark.example bookworm main\n"
            "deb-src http://source.example bookworm main\n"
            "deb http://vendor.example stable-vendor main\n"
            f"deb {MIRROR}-security bookworm-security main\n"
            f"deb [arch=amd64 signed-by=/usr/share/keyrings/k.gpg]   {MIRROR}  bookworm main contrib\n"
        )
        assert self.source(apt) == (
            f"list\ndeb [arch=amd64 signed-by=/usr/share/keyrings/k.gpg] {MIRROR} bookworm-backports main\n"
        )

    def test_a_one_line_entry_without_options_will_do(self, apt: Path) -> None:
        (apt / "sources.list.d" / "x.list").write_text(f"deb {MIRROR} bookworm main\n")
        assert self.source(apt) == f"list\ndeb {MIRROR} bookworm-backports main\n"

    def test_without_an_entry_of_the_suite_there_is_none(self, apt: Path) -> None:
        (apt / "sources.list").write_text("deb http://vendor.example focal main\n")
        assert shell("backports_source bookworm", apt=apt).returncode == 1

    @pytest.mark.parametrize(
        ("line", "known"),
        [
            (f"deb {MIRROR} bookworm-backports main\n", True),
            (f"# deb {MIRROR} bookworm-backports main\n", False),
            (f"deb {MIRROR} bookworm main\n", False),
        ],
    )
    def test_backports_that_are_configured_already_are_noticed(
        self, apt: Path, line: str, known: bool
    ) -> None:
        (apt / "sources.list").write_text(line)
        assert (shell("has_backports bookworm", apt=apt).returncode == 0) is known


class TestOrdinaryUser:
    def test_gets_the_commands_and_exit_code_1_on_debian_12(self, apt: Path, tmp_path: Path) -> None:
        (apt / "sources.list").write_text(f"deb {MIRROR} bookworm main\n")
        release = os_release(tmp_path, BOOKWORM)
        done = shell(f"{USER_WITHOUT_DRIVER}\nmain", apt=apt, release=release)
        assert done.returncode == 1
        commands = (
            f"sudo tee {apt}/sources.list.d/mikasa-vla-backports.list >/dev/null <<'EOF'\n"
            f"deb {MIRROR} bookworm-backports main\nEOF\n"
            "sudo apt-get update\n"
            "sudo apt-get install -y --no-install-recommends -t bookworm-backports "
            "mesa-vulkan-drivers libvulkan1\n"
        )
        assert commands in done.stderr
        assert "apt-get was called" not in done.stdout + done.stderr
        assert not list((apt / "sources.list.d").iterdir())

    @pytest.mark.parametrize("text", [NOBLE, TRIXIE])
    def test_needs_no_backports_elsewhere(self, apt: Path, tmp_path: Path, text: str) -> None:
        done = shell(f"{USER_WITHOUT_DRIVER}\nmain", apt=apt, release=os_release(tmp_path, text))
        assert done.returncode == 1
        assert (
            "sudo apt-get install -y --no-install-recommends mesa-vulkan-drivers libvulkan1\n" in done.stderr
        )
        assert "backports" not in done.stderr

    def test_is_told_when_there_is_no_mirror_to_take(self, apt: Path, tmp_path: Path) -> None:
        done = shell(f"{USER_WITHOUT_DRIVER}\nmain", apt=apt, release=os_release(tmp_path, BOOKWORM))
        assert done.returncode == 1
        assert "Add the suite bookworm-backports of your mirror" in done.stderr

    def test_is_told_the_names_where_there_is_no_apt(self) -> None:
        no_apt = 'command() { [ "$2" != apt-get ] && builtin command "$@"; }'
        done = shell(f"{USER_WITHOUT_DRIVER}\nunset -f apt-get\n{no_apt}\nmain")
        assert done.returncode == 1
        assert "missing here: mesa-vulkan-drivers libvulkan1" in done.stderr


class TestDriver:
    def missing(self, functions: str, **variables: str) -> list[str]:
        machine = "is_usable_venv() { return 0; }\nid() { echo 0; }\n"
        done = shell(f"{machine}{functions}\nmissing_packages", **variables)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    ALL_LIBRARIES = "has_library() { return 0; }\n"
    NO_NVIDIA = "has_nvidia_vulkan() { return 1; }\n"

    @pytest.mark.skipif(shutil.which("dpkg") is None, reason="compares versions with dpkg")
    @pytest.mark.parametrize(
        ("version", "enough"),
        [
            ("25.0.7-2~bpo12+1", True),
            ("24.3.1-1", True),
            ("24.2.8-1", False),
            ("22.3.6-1", False),
            ("", False),
        ],
    )
    def test_mesa_from_24_3_on_is_enough(self, version: str, enough: bool) -> None:
        functions = f"{self.ALL_LIBRARIES}{self.NO_NVIDIA}installed_mesa() {{ echo '{version}'; }}"
        assert (self.missing(functions) == []) is enough

    def test_with_nvidias_driver_no_mesa_is_installed(self) -> None:
        functions = f"{self.ALL_LIBRARIES}has_nvidia_vulkan() {{ return 0; }}\ninstalled_mesa() {{ :; }}"
        assert self.missing(functions) == []

    def test_with_nvidias_driver_the_libraries_it_needs_are(self) -> None:
        functions = "has_library() { return 1; }\nhas_nvidia_vulkan() { return 0; }\ninstalled_mesa() { :; }"
        assert self.missing(functions) == ["libx11-6", "libxext6", "libvulkan1"]

    def test_driver_files_that_the_user_names_are_trusted(self) -> None:
        functions = f"{self.ALL_LIBRARIES}{self.NO_NVIDIA}installed_mesa() {{ :; }}"
        assert self.missing(functions, VK_DRIVER_FILES="/somewhere/icd.json") == []

    def test_an_administrator_is_told_when_apt_has_no_new_enough_mesa(
        self, tmp_path: Path, apt: Path
    ) -> None:
        functions = (
            "id() { echo 0; }\nhas_vulkan_driver() { return 1; }\nhas_library() { return 0; }\n"
            "is_usable_venv() { return 0; }\ncandidate_mesa() { echo 23.2.1-1ubuntu3; }\n"
            'bash() { echo "would run: $2"; }\n'
        )
        done = shell(f"{functions}main", apt=apt, release=os_release(tmp_path, NOBLE))
        assert done.returncode == 1
        assert "apt offers 23.2.1-1ubuntu3 here" in done.stderr
        assert "install" not in done.stdout.replace("setup: installing", "")


class TestPython:
    @pytest.fixture
    def good(self) -> Path:
        """A Python that is right: the one of these tests."""
        return Path(sys.executable).resolve()

    def test_a_shim_that_refuses_is_passed_over_for_pyenvs_own(self, tmp_path: Path, good: Path) -> None:
        shims, version = tmp_path / "shims", f"{sys.version_info[0]}.{sys.version_info[1]}"
        installed = tmp_path / "pyenv" / "versions" / f"{version}.9" / "bin"
        shims.mkdir()
        installed.mkdir(parents=True)
        (shims / f"python{version}").write_text("#!/bin/sh\necho 'pyenv: command not found' >&2\nexit 127\n")
        (shims / f"python{version}").chmod(0o755)
        wrapper = installed / f"python{version}"
        wrapper.write_text(f'#!/bin/sh\nexec "{good}" "$@"\n')
        wrapper.chmod(0o755)
        path = f"{shims}:/usr/bin:/bin"
        done = shell("find_python can_make_venv", PATH=path, PYENV_ROOT=str(tmp_path / "pyenv"))
        assert done.stdout.strip() == str(wrapper)

    def test_the_named_python_is_used(self, good: Path) -> None:
        assert shell("find_python can_make_venv", PYTHON=str(good)).stdout.strip() == str(good)

    def test_a_named_python_that_is_wrong_stops_set_up(self) -> None:
        done = shell("ensure_python", PYTHON="/bin/no-python")
        assert done.returncode == 1
        assert "PYTHON=/bin/no-python is not a complete Python 3.12 or 3.13: " in done.stderr
        assert "No such file" in done.stderr

    @pytest.mark.parametrize(
        ("release", "package"),
        [(NOBLE, "python3.12-venv"), (TRIXIE, "python3.13-venv"), (BOOKWORM, "python3-venv")],
    )
    def test_the_distributions_own_python_is_asked_for(
        self, tmp_path: Path, release: str, package: str
    ) -> None:
        none = "find_python() { return 1; }\ncan_make_venv() { return 1; }\n"
        done = shell(f"{none}python_package", release=os_release(tmp_path, release))
        assert done.stdout.strip() == package

    def test_a_right_python_without_venv_gets_its_own_package(self, tmp_path: Path) -> None:
        version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
        functions = f'find_python() {{ [ "$1" = true ] && echo "{sys.executable}"; }}\n'
        assert shell(f"{functions}python_package").stdout.strip() == f"{version}-venv"


class TestPackages:
    @pytest.fixture
    def venv(self, tmp_path: Path) -> Path:
        """An environment whose pip is told of a mirror, and whose uv says what it was told."""
        venv = tmp_path / "venv"
        (venv / "bin").mkdir(parents=True)
        python = '#!/bin/sh\n[ "$3 $4" = "config get" ] && echo http://conf.example/simple\nexit 0\n'
        (venv / "bin" / "python").write_text(python)
        (venv / "bin" / "uv").write_text('#!/bin/sh\nenv\necho "arguments $*"\n')
        for file in (venv / "bin").iterdir():
            file.chmod(0o755)
        return venv

    def told(self, venv: Path, **variables: str) -> str:
        names = f"VENV={venv} VENV_PYTHON={venv}/bin/python LOG={venv}/log"
        done = shell(f"{names}\nuv_install -c constraints.txt -e '.[dev]'", **variables)
        assert done.returncode == 0, done.stderr
        return (venv / "log").read_text()

    def test_uv_gets_the_index_the_wheels_and_the_certificates_that_pip_has(self, venv: Path) -> None:
        told = self.told(venv, PIP_FIND_LINKS="/a /b", PIP_CERT="/c.pem")
        for line in (
            "UV_DEFAULT_INDEX=http://conf.example/simple",
            "UV_FIND_LINKS=/a,/b",
            "SSL_CERT_FILE=/c.pem",
            f"arguments pip install --python {venv}/bin/python -c constraints.txt -e .[dev]",
        ):
            assert f"{line}\n" in told
        told = self.told(venv, PIP_INDEX_URL="http://variable.example/simple")
        assert "UV_DEFAULT_INDEX=http://variable.example/simple\n" in told

    @pytest.mark.parametrize(
        ("uv", "variables"),
        [
            ("return 1", {}),
            # Its last word is what counts, not that of the filter of its lines.
            ("false | show_progress", {}),
            (None, {"PIP_NO_INDEX": "1"}),
            (None, {"MIKASA_NO_UV": "1"}),
        ],
    )
    def test_where_uv_cannot_install_pip_does(
        self, venv: Path, uv: str | None, variables: dict[str, str]
    ) -> None:
        names = f"VENV={venv} VENV_PYTHON={venv}/bin/python LOG={venv}/log"
        uv_install = "" if uv is None else f"uv_install() {{ {uv}; }}\n"
        done = shell(
            f'{names}\n{uv_install}pip_install() {{ echo "pip: $*"; }}\ninstall_packages -e .', **variables
        )
        assert done.stdout == "setup:   by pip\npip: -e .\n"

    def test_large_downloads_are_told_whoever_makes_them(self) -> None:
        lines = [
            "  Downloading torch-2.11.0-cp312-cp312-manylinux_2_28_x86_64.whl (530.7 MB)",
            "  Downloading six-1.17.0-py2.py3-none-any.whl (11 kB)",
            "Downloading torch (506.1MiB)",
            "Downloading pillow (6.3MiB)",
            "Prepared 199 packages in 1m 2s",
        ]
        done = shell("printf '%s\\n' \"$LINES_SHOWN\" | show_progress", LINES_SHOWN="\n".join(lines))
        assert done.stdout.splitlines() == [
            "setup:   downloading torch-2.11.0 (530.7 MB)",
            "setup:   downloading torch (506.1MiB)",
            "setup:   installing",
        ]


def test_a_finished_set_up_does_nothing_when_run_again() -> None:
    functions = (
        "is_up_to_date() { return 0; }\nensure_system() { :; }\n"
        "make_venv() { echo made; }\npip_install() { echo installed; }\nuv_install() { echo installed; }\n"
    )
    done = shell(f"{functions}main")
    assert (done.returncode, done.stdout) == (0, "")


def test_cv2_is_the_headless_one() -> None:
    script = "import cv2; print(cv2.__version__); print(cv2.getBuildInformation())"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("4.")
    gui = [line.split()[-1] for line in done.stdout.splitlines() if line.strip().startswith("GUI:")]
    assert gui == ["NONE"]


def test_an_environment_behind_a_link_is_not_cleared(tmp_path: Path) -> None:
    """Another checkout may be using it; `venv --clear` would follow the link."""
    other = tmp_path / "other"
    other.mkdir()
    (other / "kept").touch()
    (tmp_path / ".venv").symlink_to(other)
    enough_room = "df() { printf 'a b c 99999999\\n%.0s' 1 2; }"
    done = shell(f"cd {tmp_path}\nPYTHON={shlex.quote(sys.executable)}\n{enough_room}\nmake_venv")
    assert done.returncode == 1
    assert f".venv is a link to {other.resolve()}" in done.stderr
    assert (other / "kept").exists()
