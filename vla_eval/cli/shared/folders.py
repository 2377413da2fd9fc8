"""What a folder that a user names is: a run, training, dataset or checkpoint; and what to do with it."""

import os
import shlex
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from vla_eval.checkpoints.files import CONFIG_FILE, find_checkpoint, weights_file
from vla_eval.checkpoints.files import read_facts as read_training_facts
from vla_eval.data.facts import find_facts
from vla_eval.data.info_file import INFO_FILE, read_info
from vla_eval.errors import RunFolderError, some_of
from vla_eval.storage.folders import kind_of, what_is
from vla_eval.storage.run_file import RUN_FILE
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.catalog import task_spec
from vla_eval.training.run_folder import RUN_FILE as TRAINING_FILE
from vla_eval.training.run_folder import newest_step, read_record

AGENT_KEY = "observation"  # of the description of a training by rewards

type Lines = Iterator[tuple[str, str]]  # label, text


class _Kind(NamedTuple):
    """A kind of folder: its word in `kind_of`, what it holds, and the next commands."""

    word: str
    lines: Callable[[Path], Lines]
    next_steps: tuple[str, ...]


def folder_lines(folder: Path) -> Lines:
    """Yield label and text of each line that describes a folder."""
    for kind in KINDS:
        if kind.word == kind_of(folder):
            yield kind.word, str(folder)
            yield from kind.lines(folder)
            for index, step in enumerate(kind.next_steps):
                words = agent_evaluation(folder) if kind.word == "training" else None
                command = None if words is None else shlex.join(["mikasa-vla", *words])
                yield "" if index else "next", command or step.format(folder=shlex.quote(str(folder)))
            return
    found = some_of(sorted(os.listdir(folder))) or "nothing"
    raise RunFolderError(
        f"{folder}: expected a run ({RUN_FILE}), a training ({TRAINING_FILE}), a dataset ({INFO_FILE}) or a "
        f"checkpoint ({CONFIG_FILE} and weights); found {found}.{what_is(folder)}"
    )


def agent_evaluation(folder: Path) -> tuple[str, ...] | None:
    """Return the words of the command that evaluates an agent of this run; None: it is of another kind."""
    record = read_record(folder)
    if AGENT_KEY not in record:
        return None
    tasks, env = record.get("tasks"), record.get("env")
    task = str(tasks[0]) if isinstance(tasks, list) and tasks else "TASK"
    control = "memoryless" if task != "TASK" and task_spec(task).is_base else "cue_blind"
    sets = [("--set", f"env.{name}={value}") for name, value in (env or {}).items()]
    flags = ("--task", task, "--policy", str(folder), control, "oracle")
    return ("eval", *flags, *(word for pair in sets for word in pair))


def _of_run(folder: Path) -> Lines:
    run = read_run(folder)
    outcomes = Counter(record.outcome for record in run.records)
    yield "command", run.description.command
    yield "tasks", some_of(sorted({record.key.task for record in run.records})) or "no episode yet"
    yield "policies", some_of(sorted({record.key.policy for record in run.records})) or "no episode yet"
    yield "episodes", ", ".join(f"{outcomes[name]} {name}" for name in sorted(outcomes)) or "none yet"


def _of_training(folder: Path) -> Lines:
    record = read_record(folder)
    yield "policy", str(record.get("policy"))
    yield "command", str(record.get("command"))
    yield "step", f"{newest_step(folder)}, the newest checkpoint's"


def _of_dataset(folder: Path) -> Lines:
    info, facts = read_info(folder), find_facts(folder)
    yield "about", facts.kind if facts is not None else "a LeRobotDataset of another program"
    yield "episodes", f"{info['total_episodes']}, {info['total_frames']} frames, {info['fps']:g} a second"
    if facts is not None:
        yield "tasks", some_of(facts.tasks)
        yield "actions", facts.control_mode
    yield "features", ", ".join(info["features"])


def _of_checkpoint(folder: Path) -> Lines:
    found = find_checkpoint(folder)
    facts = read_training_facts(found)
    weights = weights_file(found)
    if weights is not None:
        yield "weights", f"{weights} ({weights.stat().st_size / 1e6:.1f} MB)"
    if facts is None:
        yield "trained on", "not noted: trained by another program"
    else:
        yield "trained on", f"{facts.dataset} ({some_of(facts.tasks) or facts.task or 'no task noted'})"
        yield "actions", facts.control_mode


EVALUATE = "mikasa-vla eval --task TASK --policy {folder} cue_blind oracle random"
KINDS = (
    _Kind(
        "run",
        _of_run,
        ("mikasa-vla report {folder}", "mikasa-vla report {folder} --html PAGE", "mikasa-vla view {folder}"),
    ),
    _Kind("training", _of_training, (EVALUATE,)),
    _Kind(
        "dataset",
        _of_dataset,
        ("mikasa-vla dataset check {folder}", "mikasa-vla finetune --policy RECIPE --dataset {folder}"),
    ),
    _Kind("checkpoint", _of_checkpoint, ("mikasa-vla checkpoint verify {folder}", EVALUATE)),
)
