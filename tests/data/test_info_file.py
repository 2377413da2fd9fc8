"""lerobot is given no `info.json` by which it could leave the folder, call anything, or compute with text."""

import json
from pathlib import Path
from typing import Any

import pytest

from vla_eval.data.opening import open_local_dataset
from vla_eval.errors import DatasetError

HOSTILE: dict[str, tuple[dict[str, Any], str]] = {
    "text for a count": ({"total_episodes": "1"}, "total_episodes '1' .expected a whole number"),
    "more episodes than there are": ({"total_episodes": 10**12}, "meta/episodes has 4"),
    "a negative count": ({"total_frames": -1}, "total_frames -1"),
    "no frames per second": ({"fps": 0}, "fps 0"),
    "true for frames per second": ({"fps": True}, "fps True"),
    "an attribute in a path": ({"data_path": "{file_index.__class__}"}, "data_path .*no places but"),
    "an item in a path": ({"data_path": "{file_index[0]}"}, "no places but"),
    "an endless width": ({"data_path": "{file_index:999999999d}"}, "no places but"),
    "a conversion": ({"data_path": "{file_index!r}"}, "no places but"),
    "an unknown place": ({"data_path": "{root}"}, "no places but"),
    "a brace that does not end": ({"video_path": "{video_key"}, "no places but"),
    "a list for a path": ({"video_path": ["a"]}, "expected text"),
    "no features": ({"features": None}, "features None .expected a mapping"),
    "a feature that is text": ({"features": {"action": "float32"}}, "features.action 'float32'"),
    "a feature without a shape": ({"features": {"action": {"dtype": "float32"}}}, "no field 'shape'"),
    "a feature that leaves the folder": (
        {"features": {"../a": {"dtype": "video", "shape": [1]}}},
        "feature '../a'",
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_info_is_refused_before_lerobot_reads_it(recorded: Path, name: str) -> None:
    changes, message = HOSTILE[name]
    file = recorded / "meta/info.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))
    with pytest.raises(DatasetError, match=message):
        open_local_dataset(recorded)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"fps": NaN}', '{"fps": 1, "fps": 2}', "{}"])
def test_what_is_no_info_is_one_message(recorded: Path, text: str) -> None:
    (recorded / "meta/info.json").write_text(text)
    with pytest.raises(DatasetError, match=r"info\.json: expected a LeRobotDataset's info"):
        open_local_dataset(recorded)


def test_fields_of_other_versions_of_lerobot_are_left_to_it(recorded: Path) -> None:
    file = recorded / "meta/info.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "tools": None, "later": [1]}))
    assert open_local_dataset(recorded).meta.total_episodes == 4
