"""Memory that was used once is used again, without the kernel filling it with zeros each time."""

import subprocess
import sys

import pytest

PROGRAM = """
import resource
import numpy as np
from vla_eval.training.finetune import keep_freed_memory

assert keep_freed_memory()
for _ in range(2):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    array = np.ones(2**26, dtype=np.uint8)  # 64 MiB: 16,384 pages of 4 KiB
    del array
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults() -> list[int]:
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120)
    return [int(line) for line in done.stdout.split()]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc alone is asked")
def test_a_block_that_was_freed_costs_no_page_faults_the_second_time() -> None:
    first, second = page_faults()
    assert second < first / 100
