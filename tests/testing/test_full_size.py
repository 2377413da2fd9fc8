"""The published sizes, rehearsed with random weights: minutes, 30 GB of disk and 20 GB of memory.

`make rehearse` runs the same parts; what it has done at this commit is not run again here.
"""

import subprocess
import sys

import pytest

from tests.testing.script_files import SCRIPTS, load_script

pytestmark = pytest.mark.full_size


@pytest.mark.parametrize("part", load_script("rehearse").PARTS)
def test_a_part_of_the_rehearsal_has_the_published_parameters_and_stays_within_its_memory(part: str) -> None:
    done = subprocess.run([sys.executable, str(SCRIPTS / "rehearse.py"), "--part", part], check=False)
    assert done.returncode == 0
