"""Random input against everything that reads a file or a flag.

Each test runs 50 cases that are the same every time. `pytest -m fuzz` runs these tests alone, with 20,000
new cases each.
"""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

CASES, MANY_CASES = 50, 20_000  # some 130 tests: more than 6,000 cases in the default run
RELAXED = {
    "deadline": None,  # one slow case is no failure: the machine may be busy
    "database": None,  # a run depends on nothing that an earlier one left
    "suppress_health_check": [HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
}
settings.register_profile("default_run", max_examples=CASES, derandomize=True, **RELAXED)
settings.register_profile("many", max_examples=MANY_CASES, **RELAXED)


def pytest_configure(config: pytest.Config) -> None:
    """Choose how many cases a test runs."""
    settings.load_profile("many" if config.getoption("markexpr") == "fuzz" else "default_run")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of this folder."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.fuzz)
