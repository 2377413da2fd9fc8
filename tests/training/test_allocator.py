"""Memory that was used once is used again, without the kernel filling it with zeros each time."""

import os
import resource
import sys

import numpy as np
import pytest

from vla_eval.training.finetune import keep_freed_memory


def page_faults() -> list[int]:
    """Return how many page faults each of two arrays costs, in a fork: malloc cannot be set back."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        assert keep_freed_memory()
        for _ in range(2):
            before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
            array = np.ones(2**26, dtype=np.uint8)  # 64 MiB: 16,384 pages of 4 KiB
            del array
            faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
            os.write(writer, f"{faults}\n".encode())
        os._exit(0)
    os.close(writer)
    os.waitpid(child, 0)
    with os.fdopen(reader) as file:
        return [int(line) for line in file]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc alone is asked")
def test_a_block_that_was_freed_costs_no_page_faults_the_second_time() -> None:
    first, second = page_faults()
    assert second < first / 100
