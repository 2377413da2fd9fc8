"""In which settings run folders differ, and in which environments they were made."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any  # arguments of tasks

from vla_eval.control_modes import CONTROL_MODE
from vla_eval.errors import TaskArgumentError, UnknownNameError
from vla_eval.features import IMAGE_SIZE_PX
from vla_eval.results.passport.fields import setting_sections
from vla_eval.robots.find import ROBOT, ROBOT_UIDS, control_mode_of, robot_of
from vla_eval.robots.rows import PANDA
from vla_eval.storage.run_file import DEVICE, leaves
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.arguments import HORIZON, horizon_steps, longest_wait_steps
from vla_eval.tasks.catalog import find_task
from vla_eval.tasks.interface import IMAGE_SIZE
from vla_eval.tasks.spec import TaskSpec

TASK_VERSIONS = "task_versions"  # task id -> version of its rules, in the configuration of a run
PROMPTS = "prompts/"  # recipes whose names have this prefix hold the instructions
DIGITS = 8
DEFAULT = "default"
DEVICE_FACTS = f"{DEVICE}."
ENV = "env."
FAKE = "fake"


def settings_of(run: StoredRun) -> dict[str, str]:
    """Return path -> text of the settings of a run that affect success and are not in an episode's key."""
    config = run.description.config
    chosen = {name: config[name] for name in setting_sections() if name in config}
    settings = {path: text.strip('"') for path, text in leaves(chosen, prefix="")}
    name = robot_name({ROBOT_UIDS: uid}) if (uid := settings.get(f"{ENV}{ROBOT_UIDS}")) else PANDA.name
    if name not in (PANDA.name, uid):  # the uids of the Panda differ in the mesh of its camera
        settings[f"{ENV}{ROBOT}"] = name
        del settings[f"{ENV}{ROBOT_UIDS}"]
    # Other weights of a policy may be another training run; another instruction is another variant.
    return settings | {name: digest[:DIGITS] for name, digest in prompts_of(run).items()}


def prompts_of(run: StoredRun) -> dict[str, str]:
    """Return the recipes of a run that hold the instructions, with their digests."""
    return {name: digest for name, digest in run.description.recipes.items() if name.startswith(PROMPTS)}


def task_version(run: StoredRun, task: str) -> object:
    """Return the version of a task's rules in a run; None if the run does not say."""
    versions = run.description.config.get(TASK_VERSIONS)
    return versions.get(task) if isinstance(versions, Mapping) else None


def task_of(run: StoredRun, task: str) -> TaskSpec | None:
    """Return the task's row of the catalogue; None if the run has it in another version, or does not say."""
    spec = find_task(task)
    return spec if spec is not None and spec.version == task_version(run, task) else None


def arguments_of(run: StoredRun) -> Mapping[str, Any] | None:
    """Return the arguments that a run gives its tasks; None if it does not say."""
    env = run.description.config.get("env")
    return env if isinstance(env, Mapping) else None


def usual_arguments(run: StoredRun, task: str) -> dict[str, str]:
    """Return path -> text of the arguments that hold in a run's task without being named, if known."""
    spec, env = task_of(run, task), arguments_of(run)
    if spec is None or env is None or spec.is_base or run.description.config.get("simulator") == FAKE:
        return {}
    usual = {IMAGE_SIZE: str(IMAGE_SIZE_PX), **_of_robot(env)}
    horizon = _usual_horizon(spec, env)
    if horizon is not None:
        usual[HORIZON] = str(horizon)
    return {f"{ENV}{name}": text for name, text in usual.items()}


def full_settings(run: StoredRun, task: str) -> dict[str, str]:
    """Return path -> text of the settings of a run's task: those named, and those that hold anyway."""
    return usual_arguments(run, task) | settings_of(run)


def robot_name(env: Mapping[str, Any]) -> str:
    """Return the robot that arguments name, or the default; as they name it if it is not installed here."""
    try:
        return robot_of(env).name
    except (TaskArgumentError, UnknownNameError):
        return str(env.get(ROBOT, env.get(ROBOT_UIDS)))


def _of_robot(env: Mapping[str, Any]) -> dict[str, str]:
    """Return the robot, where no argument names one, and the control mode that it then has."""
    try:
        usual = {CONTROL_MODE: control_mode_of(env)}
    except (TaskArgumentError, UnknownNameError):
        return {}
    return usual if ROBOT_UIDS in env else {ROBOT: robot_name(env), **usual}


def _usual_horizon(spec: TaskSpec, env: Mapping[str, Any]) -> int | None:
    """Return the control steps of an episode for which no horizon is named; None if that is impossible."""
    try:
        return horizon_steps(spec, 0 if spec.is_official else longest_wait_steps(spec, env))
    except (TaskArgumentError, UnknownNameError):
        # The phases are too long without the horizon that the run names, or its robot is not installed here.
        return None


def variant_labels(runs: Sequence[StoredRun]) -> list[dict[str, str | None]]:
    """Return for each run: task -> what it sets that differs between runs (nothing: `DEFAULT`), or None."""
    tasks = [sorted({record.task for record in run.records}) for run in runs]
    stated = [settings_of(run) for run in runs]
    full = [
        {task: usual_arguments(run, task) | own for task in of_run}
        for run, own, of_run in zip(runs, stated, tasks, strict=True)
    ]
    names = sorted({name for own in stated for name in own})
    differing = [name for name in names if _differs(name, stated, full)]
    versions: dict[str, set[object]] = defaultdict(set)
    for run, of_run in zip(runs, tasks, strict=True):
        for task in of_run:
            versions[task].add(task_version(run, task))
    labels = []
    for run, by_task in zip(runs, full, strict=True):
        label_of: dict[str, str | None] = {}
        for task, own in by_task.items():
            parts = [f"{name}={own[name]}" for name in differing if name in own]
            parts = parts or ([DEFAULT] if differing else [])
            version = [f"task version {task_version(run, task)}"] if len(versions[task]) > 1 else []
            label_of[task] = ", ".join((*parts, *version)) or None
        labels.append(label_of)
    return labels


def _differs(
    name: str, stated: Sequence[Mapping[str, str]], full: Sequence[Mapping[str, Mapping[str, str]]]
) -> bool:
    """Whether runs differ in a setting: not if one names what stands in the other without being named."""
    if len({own.get(name) for own in stated}) < 2:
        return False
    values: dict[str, set[str | None]] = defaultdict(set)
    for by_task in full:
        for task, own in by_task.items():
            values[task].add(own.get(name))
    is_known = all(name in own for by_task in full for own in by_task.values())
    return not is_known or any(len(found) > 1 for found in values.values())


def differing_environment(runs: Sequence[StoredRun]) -> list[str]:
    """Return the leaves of the environment in which run folders differ.

    A run without images has no renderer, and one of which no worker has started has no device at all: what is
    not known does not differ.
    """
    texts = [dict(leaves(run.description.environment, prefix="")) for run in runs]
    found = {
        name: {text.get(name) for text in texts if name in text or not name.startswith(DEVICE_FACTS)}
        for text in texts
        for name in text
    }
    return [name for name, values in found.items() if len(values) > 1]


def differing_recipes(runs: Sequence[StoredRun]) -> list[str]:
    """Return the recipes that have other contents in one run folder than in another, without instructions."""
    digests: dict[str, set[str]] = defaultdict(set)
    for run in runs:
        for recipe, digest in run.description.recipes.items():
            digests[recipe].add(digest)
    # Other prompts are another variant, for which the table has a column.
    return [name for name, found in digests.items() if len(found) > 1 and not name.startswith(PROMPTS)]
