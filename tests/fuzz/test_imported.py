"""Random results of other programs: they are printed in every format, or refused with a message."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.json_cases import BYTES, VALUES, accepted_or_refused, as_bytes, near
from tests.results.test_imported import allenai, inspect_robots, lerobot, official, openvla_oft, robostats
from vla_eval.results.imported.reading import read_imported
from vla_eval.results.table_formats import render_beside

JSON = {"lerobot": lerobot(), "allenai": allenai(), "official": official(), "inspect": inspect_robots()}
TEXT = {"robostats": robostats(), "openvla_oft": openvla_oft()}


def read_and_print(path: Path, content: bytes) -> None:
    """Read a file and print it as `report --imported` does."""
    path.write_bytes(content)

    def report() -> None:
        rows = read_imported(path)
        for fmt in ("markdown", "csv", "json", "latex", "html-table"):
            render_beside(fmt, published=None, imported=rows)  # type: ignore[arg-type]  # one of them

    accepted_or_refused(report)


@pytest.mark.parametrize("program", sorted(JSON))
@given(data=st.data())
def test_fields_that_are_wrong_missing_or_more(program: str, data: st.DataObject, tmp_path: Path) -> None:
    read_and_print(tmp_path / "results", as_bytes(data.draw(near(JSON[program]))))


@pytest.mark.parametrize("program", sorted(TEXT))
@given(data=st.data())
def test_lines_that_are_wrong_missing_or_more(program: str, data: st.DataObject, tmp_path: Path) -> None:
    lines = TEXT[program].encode().splitlines()
    place = data.draw(st.integers(0, len(lines)))
    line = data.draw(BYTES | st.sampled_from(lines))
    read_and_print(tmp_path / "results", b"\n".join([*lines[:place], line, *lines[place + 1 :]]))


@given(content=BYTES | VALUES.map(as_bytes))
def test_anything_at_all(content: bytes, tmp_path: Path) -> None:
    read_and_print(tmp_path / "results", content)
