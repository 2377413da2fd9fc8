"""`make base`: the system libraries by which Memory Maze draws without a screen."""

from pathlib import Path

import pytest

from tests.packaging.test_setup_scripts import BOOKWORM, ROOT, os_release, shell


class TestRendererOfMemoryMaze:
    BASE = "source scripts/base.sh\nhas_labmaze() { return 0; }\n"
    BARE = (
        "has_library() { return 1; }\nhas_software_gl() { return 1; }\n"
        "apt-get() { echo 'apt-get was called'; }\n"
    )

    def test_an_ordinary_user_gets_the_command_and_the_packages_of_all_other_tasks(
        self, tmp_path: Path
    ) -> None:
        functions = f"{self.BASE}{self.BARE}id() {{ echo 1000; }}\nVENV_PYTHON=true\n"
        done = shell(f"{functions}install_base", release=os_release(tmp_path, BOOKWORM))
        assert done.returncode == 0, done.stderr
        command = "sudo apt-get install -y --no-install-recommends libegl1 libopengl0 libgl1-mesa-dri\n"
        assert command in done.stderr and "apt-get was called" not in done.stdout

    def test_root_installs_what_is_missing(self) -> None:
        shown = "run_commands() { printf '%s\\n' \"${COMMANDS[@]}\"; }\n"
        done = shell(f"{self.BASE}{self.BARE}id() {{ echo 0; }}\n{shown}ensure_gl")
        assert done.stdout.splitlines()[-1].endswith("libegl1 libopengl0 libgl1-mesa-dri")

    @pytest.mark.parametrize(
        ("functions", "missing"),
        [
            ("has_library() { return 0; }\nhas_software_gl() { return 0; }\n", []),
            ("has_library() { return 0; }\nhas_software_gl() { return 1; }\n", []),  # NVIDIA's
            (
                "has_library() { [ $1 != libEGL_nvidia.so.0 ]; }\nhas_software_gl() { return 1; }\n",
                ["libgl1-mesa-dri"],
            ),
        ],
    )
    def test_what_is_there_is_not_installed_again(self, functions: str, missing: list[str]) -> None:
        done = shell(f"{self.BASE}{functions}missing_gl_packages")
        assert done.stdout.split() == missing

    def test_make_setup_does_not_ask_for_it(self) -> None:
        assert "base.sh" not in (ROOT / "scripts" / "setup.sh").read_text()
