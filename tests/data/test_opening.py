"""Of the episodes lerobot's loader gets what it keeps, and does not read the rest."""

from pathlib import Path

import pytest
from lerobot.datasets import dataset_metadata
from lerobot.datasets.io_utils import load_episodes
from lerobot.datasets.utils import EPISODES_DIR

from vla_eval.data.lerobot_tables import Tables
from vla_eval.data.opening import local_readers, open_local_dataset
from vla_eval.errors import DatasetError


def test_rows_of_episodes_are_those_that_lerobot_keeps(recorded: Path) -> None:
    theirs, ours = load_episodes(recorded), open_local_dataset(recorded).meta.episodes
    assert ours.features == theirs.features and len(ours) == 4
    assert ours.to_dict() == theirs.to_dict()


def test_lerobot_is_left_as_it_was_even_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=EPISODES_DIR), local_readers(Tables):
        assert dataset_metadata.load_episodes is not load_episodes
        dataset_metadata.load_episodes(tmp_path)
    assert dataset_metadata.load_episodes is load_episodes
