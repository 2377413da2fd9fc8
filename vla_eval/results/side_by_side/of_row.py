"""Read the passport of a measured row from its run folders."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.results.grouping import Grouping, RowEpisodes, RowKey
from vla_eval.results.passport.fields import FIELDS, Kind, owner_of
from vla_eval.results.passport.passport import Passport, seeds_text
from vla_eval.results.passport.settings import (
    DIGITS,
    ENV,
    arguments_of,
    full_settings,
    prompts_of,
    robot_name,
    settings_of,
    task_of,
    task_version,
)
from vla_eval.robots.rows import PANDA
from vla_eval.seeding import SeedRange, seed_ranges
from vla_eval.storage.run_file import leaves
from vla_eval.storage.run_folder import StoredRun
from vla_eval.storage.trained_on import seeds_of_training
from vla_eval.tasks.arguments import HORIZON
from vla_eval.tasks.catalog import find_task
from vla_eval.tasks.interface import IMAGE_SIZE
from vla_eval.tasks.spec import Suite

NULL = "null"  # of JSON
ROBOTS = {PANDA.name: "Panda"}
"""Name of a robot -> what published results call it."""
NONE = "none"
AS_DESIGNED = "as designed"
OWN = "this repository's"
SUITES: Mapping[Suite, str] = {
    "paper": OWN,
    "objects": OWN,
    "real_twin": OWN,
    "mikasa_vla_90": "MIKASA-Robo-VLA",
    "mikasa_official": "MIKASA-Robo v0",
    "mikasa_base": "MIKASA-Base",
}
"""Suite of a task -> whose tasks they are, as published results say it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RowOfRun:
    """One row, as one of its run folders has it."""

    run: StoredRun
    settings: Mapping[str, str]  # path -> text: those of the run, and what holds without being named
    episodes: RowEpisodes

    @property
    def key(self) -> RowKey:
        """Task, policy, n_action_steps and variant."""
        return self.episodes.key

    def argument(self, name: str) -> str | None:
        """Return an argument of the task, named or usual; None if it is not known."""
        return self.settings.get(f"{ENV}{name}")


def passports_of(grouping: Grouping) -> dict[RowKey, Passport]:
    """Return the passport of each row; what differs between the run folders of a row has several values."""
    settings: dict[tuple[Path, str], dict[str, str]] = {}
    of_runs: dict[Path, dict[str, str | None]] = {}
    found = {}
    for key, group in grouping.groups.items():
        folders, each = grouping.folders[key], []
        for run in folders:
            place = (run.path, key.task)
            if run.path not in of_runs:
                of_runs[run.path] = _values_of_run(run, settings_of(run))
            if place not in settings:
                settings[place] = full_settings(run, key.task)
            row = RowOfRun(run=run, settings=settings[place], episodes=group)
            each.append(of_runs[run.path] | _values_of_row(row))
        values = {one.name: tuple(dict.fromkeys(own[one.name] for own in each)) for one in FIELDS}
        found[key] = Passport(subject=str(key), origin=str(folders[0].path), values=values)
    return found


def _values_of_row(row: RowOfRun) -> dict[str, str | None]:
    return {name: read(row) for name, read in READERS.items()}


def _values_of_run(run: StoredRun, settings: Mapping[str, str]) -> dict[str, str | None]:
    """Return the fields that consist of leaves of `run.json`; None where the run has nothing of the kind."""
    found: dict[str, list[str]] = {one.name: [] for one in FIELDS if one.name not in READERS}
    environment = dict(leaves(run.description.environment, prefix=""))
    kinds: Mapping[Kind, Mapping[str, str]] = {"setting": settings, "environment": environment}
    for kind, texts in kinds.items():
        for path, text in texts.items():
            owner = owner_of(path, kind)
            if owner is not None and owner.name in found and text != NULL:
                found[owner.name].append(f"{_short(path)}={text.strip('"')}")
    values: dict[str, str | None] = {name: ", ".join(texts) or None for name, texts in found.items()}
    if values["world"] is None and arguments_of(run) is not None:
        values["world"] = AS_DESIGNED
    return values


def _short(path: str) -> str:
    """Return the path without the section that its field is about."""
    return path.removeprefix(ENV).removeprefix("chunking.").removeprefix("render.")


def _tasks(row: RowOfRun) -> str | None:
    spec, version = find_task(row.key.task), task_version(row.run, row.key.task)
    if spec is None or version is None:
        return None
    return f"{SUITES[spec.suite]}, version {version}" if SUITES[spec.suite] == OWN else SUITES[spec.suite]


def _instructions(row: RowOfRun) -> str | None:
    found = prompts_of(row.run)
    return ", ".join(f"{name} ({digest[:DIGITS]})" for name, digest in found.items()) or None


def _control_mode(row: RowOfRun) -> str | None:
    return NONE if _is_base(row) else row.argument("control_mode")


def _image_size(row: RowOfRun) -> str | None:
    size = row.argument(IMAGE_SIZE)
    return NONE if _is_base(row) else None if size is None else f"{size} px"


def _robot(row: RowOfRun) -> str | None:
    env = arguments_of(row.run)
    if _is_base(row):
        return NONE
    if env is None:
        return None
    name = robot_name(env)
    return ROBOTS.get(name, name)


def horizon_of(run: StoredRun, task: str) -> int | None:
    """Return the control steps of an episode of a task in a run; None if it is not known."""
    steps = full_settings(run, task).get(f"{ENV}{HORIZON}")
    return None if steps is None else int(steps)


def _horizon(row: RowOfRun) -> str | None:
    steps = row.argument(HORIZON)
    return None if steps is None else f"{steps} control steps"


def _success_rule(row: RowOfRun) -> str | None:
    env = arguments_of(row.run)
    if env is None:
        return None
    parts = ["success at any step"]
    parts += ["the first wrong choice ends the episode"] if env.get("strict_choice") is True else []
    # Where episodes stop at their first success, success once is the same.
    return ", ".join(parts)


def _is_base(row: RowOfRun) -> bool:
    spec = task_of(row.run, row.key.task)
    return spec is not None and spec.is_base


def _seen_seeds(row: RowOfRun) -> str | None:
    asked = {(run.index, seed) for run in row.episodes.runs for seed in run.records}
    seen = {place for place in asked if any(place[1] in one for one in _trained_on(row, place[0]) or ())}
    return f"{len(seen)} of {len(asked)} episodes" if seen else NONE


def _trained_on(row: RowOfRun, index: int) -> Sequence[SeedRange] | None:
    key = row.key
    return seeds_of_training(row.run.description.training_seeds, policy=key.policy, task=key.task, run=index)


def _demonstrations(row: RowOfRun) -> str | None:
    if not any(run.weights for run in row.episodes.runs):
        return None if _is_served(row) else NONE
    found = [_trained_on(row, run.index) for run in row.episodes.runs]
    if None in found:
        return None
    return seeds_text(one for of_run in found if of_run is not None for one in of_run) or NONE


def _weights(row: RowOfRun) -> str | None:
    digests = sorted({one[:DIGITS] for run in row.episodes.runs for one in run.weights})
    return ", ".join(digests) or (None if _is_served(row) else NONE)


def _is_served(row: RowOfRun) -> bool:
    """Whether the policy is behind a socket whose server does not say which weights it has."""
    server = row.run.description.servers.get(row.key.policy)
    return server is not None and not (isinstance(server, Mapping) and "weights_sha256" in server)


def _seeds(row: RowOfRun) -> str:
    return seeds_text(seed_ranges(seed for run in row.episodes.runs for seed in run.records))


READERS: Mapping[str, Callable[[RowOfRun], str | None]] = {
    "tasks": _tasks,
    "instructions": _instructions,
    "control_mode": _control_mode,
    "image_size": _image_size,
    "robot": _robot,
    "horizon": _horizon,
    "n_action_steps": lambda row: str(row.key.n_action_steps),
    "success_rule": _success_rule,
    "seen_seeds": _seen_seeds,
    "weights": _weights,
    "training": lambda _: None,
    "demonstrations": _demonstrations,
    "seeds": _seeds,
    "episodes": lambda row: str(len(row.episodes.results)),
    "runs": lambda row: str(len(row.episodes.runs_with_results)),
}
"""Field -> how it is read; the others are the leaves of `run.json` that belong to them."""
