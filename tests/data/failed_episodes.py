"""A recording in which some episodes failed."""

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vla_eval.data.dataset_folder import digest_files
from vla_eval.data.facts import read_facts
from vla_eval.data.manifest import MANIFEST_FILE, RECORDING_FILE, read_manifest, write_entry, write_lines
from vla_eval.features import SUCCESS_KEY


def let_fail(root: Path, *numbers: int) -> Path:
    """Let the success rule never hold in these episodes of a recording; return its folder."""
    for path in (root / "data").glob("*/*.parquet"):
        table = pq.read_table(path)
        success = np.asarray(table[SUCCESS_KEY].to_pylist())
        success[np.isin(table["episode_index"].to_pylist(), numbers)] = False
        place = table.schema.get_field_index(SUCCESS_KEY)
        field = table.schema.field(place)
        pq.write_table(table.set_column(place, field, pa.array(success.tolist(), type=field.type)), path)
    episodes = [
        dataclasses.replace(one, success_step=None) if one.episode_index in numbers else one
        for one in read_manifest(root)
    ]
    write_lines(root / MANIFEST_FILE, episodes)
    facts = read_facts(root)
    recipe = {**facts.recipe, "keep": "all", "cut": "horizon"}
    write_entry(root / RECORDING_FILE, dataclasses.replace(facts, recipe=recipe, files=digest_files(root)))
    return root
