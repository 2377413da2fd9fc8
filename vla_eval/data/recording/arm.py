"""Demonstrations on an arm: each episode that is kept is a shard at once, each other one a line.

    OUT/TASK/                             a finished dataset of one stage; appears in one step
    OUT/recording/TASK/shards/shard-00007   the episode of trial 7, until the dataset is there
    OUT/recording/TASK/discarded.jsonl    one `DiscardedTrial` per episode that was not kept

The rest is as in `folder`. Knows nothing of arms and operators: frames and episodes come from above.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any  # lerobot's plain data

from vla_eval.data.dataset_folder import digest_files
from vla_eval.data.facts import ArmFacts, find_facts
from vla_eval.data.manifest import (
    ARM_FILE,
    FAILED_FILE,
    MIKASA_FOLDER,
    ArmEpisode,
    DiscardedTrial,
    read_entries,
    to_json,
    write_entry,
    write_lines,
)
from vla_eval.data.recording.folder import SHARDS, STATE_FOLDER, RecordingFolder, remove_shards
from vla_eval.data.recording.shard_writer import ShardWriter, join_shards
from vla_eval.features import EncoderSettings
from vla_eval.specs import EnvSpec
from vla_eval.storage.drafts import DRAFT_SUFFIX, draft_path, publish, remove_drafts
from vla_eval.storage.durable import LineFile, cut_tail

DISCARDED_FILE = "discarded.jsonl"


class StageRecording:
    """What a recording has of one stage."""

    def __init__(self, folder: RecordingFolder, task: str) -> None:
        """Read what there is."""
        self._folder, self.task = folder, task
        state = folder.out / STATE_FOLDER / task
        self._discarded_path = state / DISCARDED_FILE
        shards = (state / SHARDS).glob("shard-*")
        whole = [path for path in shards if path.suffix != DRAFT_SUFFIX]
        self.shards = {int(path.name.partition("-")[2]): path for path in sorted(whole)}
        self.discarded: dict[int, DiscardedTrial] = {}
        if self._discarded_path.exists():
            cut_tail(self._discarded_path)
            self.discarded = {one.number: one for one in read_entries(self._discarded_path, DiscardedTrial)}

    @property
    def path(self) -> Path:
        """Where the dataset appears."""
        return self._folder.out / self.task

    @property
    def is_finished(self) -> bool:
        """Whether it is there."""
        return (self.path / ARM_FILE).exists()

    def facts(self) -> ArmFacts:
        """Return what the finished dataset is, or raise `DatasetError`."""
        found = find_facts(self.path)
        assert isinstance(found, ArmFacts)  # `is_finished`
        return found

    def writer(self, number: int, features: dict[str, Any], *, env: EnvSpec, robot: str) -> ShardWriter:
        """Return what writes the episode of a trial."""
        return ShardWriter(
            self._folder.shard(self.task, number),
            features,
            encoder=EncoderSettings(),
            max_frames=env.horizon_steps,
            robot=robot,
            fps=int(env.control_hz),
        )

    def add(self, number: int) -> None:
        """Note that the episode of a trial has been written."""
        self.shards[number] = self._folder.shard(self.task, number)

    def discard(self, trial: DiscardedTrial) -> None:
        """Note that the episode of a trial was not kept; it is durable when this returns."""
        self._discarded_path.parent.mkdir(parents=True, exist_ok=True)
        file = LineFile(self._discarded_path, durable=True)
        try:
            file.append(to_json(trial))
        finally:
            file.close()
        self.discarded[trial.number] = trial

    def join(self, numbers: Sequence[int], facts: ArmFacts) -> ArmFacts:
        """Put the episodes of these trials together as the dataset; `facts` are without what they hold."""
        home = self._folder.shard(self.task, 0).parent / self.path.name
        remove_drafts(home)
        draft = draft_path(home)
        episodes = join_shards([self.shards[number] for number in numbers], draft, ArmEpisode)
        (draft / MIKASA_FOLDER).mkdir()
        write_lines(draft / FAILED_FILE, list(self.discarded.values()))
        found = dataclasses.replace(
            facts,
            n_frames=sum(one.n_steps for one in episodes),
            n_discarded=len(self.discarded),
            episodes=episodes,
            files=digest_files(draft),
        )
        write_entry(draft / ARM_FILE, found)
        self.path.parent.mkdir(parents=True, exist_ok=True)  # the id has a namespace
        publish(draft, self.path)
        remove_shards(self._folder.out, self.task)
        return found
