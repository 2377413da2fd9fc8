"""Reads the episodes of the original code; `golden/README.md` says what they hold."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).parent / "golden"


@dataclass(frozen=True, kw_only=True)
class GoldenEpisode:
    seed: int
    policy: str
    actions: Any
    rewards: Any
    terminated: bool
    fields: dict[str, Any]  # sha256, obs, trace or agent_pos
    level: dict[str, Any]
    meta: dict[str, Any]


def golden_ids() -> list[str]:
    return sorted(path.stem for path in FOLDER.glob("*.npz"))


def golden_episodes(name: str) -> Iterator[GoldenEpisode]:
    with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as file:
        data = {key: file[key] for key in file.files}
    for key, meta in json.loads(str(data["meta"])).items():
        seed, policy = key.split("/")
        fields = {n.removeprefix(f"{key}/"): v for n, v in data.items() if n.startswith(f"{key}/")}
        prefix = f"{seed}/level/"
        yield GoldenEpisode(
            seed=int(seed),
            policy=policy,
            actions=fields.pop("actions"),
            rewards=fields.pop("rewards"),
            terminated=bool(fields.pop("terminated")),
            fields=fields,
            level={n.removeprefix(prefix): v for n, v in data.items() if n.startswith(prefix)},
            meta=meta,
        )


def short_digest(observation: Any, meta: dict[str, Any]) -> bytes:
    """Return the first four bytes of the sha256 of an observation, in the dtypes of the original."""
    leaves = (
        [observation[name] for name in sorted(observation)]
        if isinstance(observation, dict)
        else [observation]
    )
    digest = hashlib.sha256()
    for leaf, dtype, shape in zip(leaves, meta["dtypes"], meta["shapes"], strict=True):
        values = np.asarray(leaf)
        cast = values.astype(dtype)
        assert np.array_equal(cast, values), "the original dtype cannot hold this observation"
        digest.update(np.ascontiguousarray(cast.reshape(shape)).tobytes())
    return digest.digest()[:4]
