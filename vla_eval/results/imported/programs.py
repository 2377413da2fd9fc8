"""The other programs whose results are read, a row each."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any  # JSON

from vla_eval.results.imported import schemas
from vla_eval.results.imported.rows import ANY_STEP, LAST_STEP, ImportedRow, check_rate, check_some
from vla_eval.results.imported.schemas import read_part
from vla_eval.strict.json_text import Source, read_json
from vla_eval.tasks.catalog import find_task

Rows = Iterator[ImportedRow]
OFFICIAL_SUITE = "mikasa_vla/"


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """One program and one kind of its files."""

    name: str
    file: str  # what the file is called, for messages
    keys: frozenset[str] = frozenset()  # of the JSON object that it is; none: it is text
    is_text: Callable[[str], bool] = lambda _: False
    read_json: Callable[[Any, Source], Rows] | None = None  # Any: JSON
    read_text: Callable[[str, Source], Rows] | None = None


def _lerobot(data: Any, source: Source) -> Rows:
    found = read_part(schemas.LerobotEval, data, source)
    successes = [one for task in found.per_task for one in task.metrics.successes]
    check_some(len(successes), source, of="per_task")
    if found.overall.n_episodes != len(successes):
        raise source.refuse(f"n_episodes {found.overall.n_episodes}", f"it has {len(successes)} episodes")
    check_rate(
        found.overall.pc_success / 100, sum(successes), len(successes), source, what="pc_success / 100 of"
    )
    for task in found.per_task:
        own = task.metrics.successes
        name = f"{task.task_group}/{task.task_id}"
        check_some(len(own), source, of=name)
        yield ImportedRow(
            program="lerobot-eval",
            file=source.where,
            task=name,
            policy=None,
            n_success=sum(own),
            n_episodes=len(own),
            stated={"success_rule": ANY_STEP},
        )


def _allenai(data: Any, source: Source) -> Rows:
    found = read_part(schemas.AllenaiResult, data, source)
    for task in found.tasks:
        results = [one for one in task.episodes if not one.failure_reason]
        n_errors = len(task.episodes) - len(results)
        check_some(len(results), source, of=task.task)
        won = [one.metrics.get("success") for one in results]
        if not all(isinstance(one, bool) for one in won):
            odd = next(one for one in won if not isinstance(one, bool))
            raise source.refuse(f"success {odd!r} in {task.task}", "expected true or false of each episode")
        n_success = sum(one is True for one in won)
        if task.mean_success is not None:
            check_rate(task.mean_success, n_success, len(task.episodes), source, what="mean_success")
        notes = [f"its own figure counts errors as failures ({n_errors})"] if n_errors else []
        notes += ["the run is not complete"] if found.partial else []
        yield ImportedRow(
            program=f"vla-evaluation-harness {found.harness_version}",
            file=source.where,
            task=task.task,
            policy=None,
            n_success=n_success,
            n_episodes=len(results),
            n_errors=n_errors,
            notes=tuple(notes),
        )


def _official(data: Any, source: Source) -> Rows:
    found = read_part(schemas.OfficialTask, data, source)
    counts = {len(found.successes), len(found.episode_seeds), found.n_episodes}
    if len(counts) > 1:
        raise source.refuse(
            f"{len(found.successes)} successes, {len(found.episode_seeds)} seeds",
            f"n_episodes is {found.n_episodes}",
        )
    check_rate(found.sr, sum(found.successes), found.n_episodes, source, what="sr")
    spec, name = find_task(f"{OFFICIAL_SUITE}{found.env_id}"), found.model.get("name")
    horizon = None if spec is None else f"{spec.horizon_steps} control steps"
    yield ImportedRow(
        program="official runner",
        file=source.where,
        task=found.env_id,
        policy=name if isinstance(name, str) else None,
        n_success=sum(found.successes),
        n_episodes=found.n_episodes,
        seeds=found.episode_seeds,
        stated={
            "tasks": "MIKASA-Robo-VLA",
            "control_mode": found.control_mode,
            "horizon": horizon,
            "success_rule": ANY_STEP,
        },
        perhaps={
            "n_action_steps": f"{found.action_chunk_size}, as the policy says; it may queue actions itself",
            "simulator": "the GPU's, the runner's default",
        },
    )


def _inspect_robots(data: Any, source: Source) -> Rows:
    found = read_part(schemas.InspectLog, data, source)
    if found.version != 1:
        raise source.refuse(f"version {found.version}", "expected version 1")
    trials = [score for sample in found.samples for score in sample.epochs]
    scores = [score.get("success_at_end") for score in trials if score]
    if any(one not in (0.0, 1.0) for one in scores):
        raise source.refuse("a score without success_at_end, or another than 0 and 1", "expected 0 or 1")
    check_some(len(scores), source, of=found.eval.task)
    spec = found.eval
    yield ImportedRow(
        program=f"inspect-robots {spec.inspect_robots_version}",
        file=source.where,
        task=spec.task,
        policy=spec.policy,
        n_success=sum(one == 1.0 for one in scores),
        n_episodes=len(scores),
        n_errors=len(trials) - len(scores),
        stated={
            "success_rule": LAST_STEP,
            "robot": spec.embodiment,
            "horizon": None if spec.max_steps is None else f"{spec.max_steps} control steps",
            "weights": spec.policy_checkpoint,
        },
        notes=() if found.status == "success" else (f"the run ended with the status {found.status}",),
    )


SUCCESS = "success"  # name of the scorer that counts, where there are several


def _inspect_ai(data: Any, source: Source) -> Rows:
    found = read_part(schemas.InspectAiLog, data, source)
    if found.version != 2:
        raise source.refuse(f"version {found.version}", "expected version 2")
    results = [one.scores for one in found.samples if one.error is None and one.scores]
    names = sorted({name for scores in results for name in scores})
    if len(names) > 1 and SUCCESS not in names:
        raise source.refuse(
            f"scores of {', '.join(names)}", f"expected one scorer, or one that is called '{SUCCESS}'"
        )
    own = names[0] if len(names) == 1 else SUCCESS
    check_some(len(results), source, of=found.eval.task)
    if found.results.completed_samples != len(results):
        raise source.refuse(
            f"completed_samples {found.results.completed_samples}", f"{len(results)} have a score"
        )
    won = [_is_correct(scores.get(own, {}).get("value"), source) for scores in results]
    yield ImportedRow(
        program="inspect_ai",
        file=source.where,
        task=found.eval.task,
        policy=found.eval.model,
        n_success=sum(won),
        n_episodes=len(won),
        n_errors=len(found.samples) - len(won),
        notes=() if found.status == SUCCESS else (f"the run ended with the status {found.status}",),
    )


def _is_correct(value: object, source: Source) -> bool:
    if value in ("C", 1):  # also 1.0 and true
        return True
    if value in ("I", 0):
        return False
    raise source.refuse(f"the score {value!r:.80}", "expected C or I, true or false, 1 or 0")


def _robostats(text: str, source: Source) -> Rows:
    records: dict[tuple[str, str], list[schemas.RobostatsRecord]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        own = Source(
            where=f"{source.where}, line {number}", what=source.what, remedy=source.remedy, error=source.error
        )
        record = read_part(schemas.RobostatsRecord, read_json(line, own), own)
        records.setdefault((record.policy_id, record.task_id), []).append(record)
    for (policy, task), of_row in records.items():
        seeds = [one.seed for one in of_row if one.seed is not None]
        yield ImportedRow(
            program="robostats",
            file=source.where,
            task=task,
            policy=policy,
            n_success=sum(one.success for one in of_row),
            n_episodes=len(of_row),
            seeds=seeds if len(seeds) == len(of_row) else None,
            stated={
                "n_action_steps": _one([one.protocol and one.protocol.execution_horizon for one in of_row]),
                "horizon": _one(
                    [one.protocol and one.protocol.max_steps for one in of_row], " control steps"
                ),
            },
        )


def _one(values: Sequence[int | schemas.RobostatsProtocol | None], unit: str = "") -> str | None:
    """Return the value that all records have; None if they differ, or it is not there."""
    found = set(values)
    return f"{values[0]}{unit}" if len(found) == 1 and values[0] is not None else None


_OFT_LINE = re.compile(
    r"(?P<what>Task suite|Task|Success|Episode error|# episodes completed so far|# successes): (?P<value>.*)"
)


def _openvla_oft(text: str, source: Source) -> Rows:
    """Count a log of openvla-oft's LIBERO script, at 213c5ff: an error is logged before `Success: False`."""
    suite, task, failed = "", "", False
    outcomes: dict[str, list[bool | None]] = {}
    for match in filter(None, map(_OFT_LINE.fullmatch, text.splitlines())):
        what, value = match["what"], match["value"]
        if what == "Task suite":
            suite = value
        elif what == "Task":
            task = value
        elif what == "Episode error":
            failed = True
        elif what == "Success":
            if value not in ("True", "False") or not task:
                raise source.refuse(f"Success: {value}", "expected True or False, below a task")
            outcomes.setdefault(task, []).append(None if failed else value == "True")
            failed = False
        else:
            _check_total(what, value, outcomes, source)
    for name, of_task in outcomes.items():
        results = [one for one in of_task if one is not None]
        check_some(len(results), source, of=name)
        n_errors = len(of_task) - len(results)
        yield ImportedRow(
            program="openvla-oft",
            file=source.where,
            task=f"{suite}: {name}" if suite else name,
            policy=None,
            n_success=sum(results),
            n_episodes=len(results),
            n_errors=n_errors,
            stated={"success_rule": ANY_STEP},  # LIBERO ends an episode at its first success
            notes=(f"its own figure counts errors as failures ({n_errors})",) if n_errors else (),
        )


def _check_total(
    what: str, value: str, outcomes: Mapping[str, Sequence[bool | None]], source: Source
) -> None:
    """Refuse a log whose running totals are not those of its episodes: a part of it is missing."""
    every = [one for of_task in outcomes.values() for one in of_task]
    counted = len(every) if what.startswith("# episodes") else sum(one is True for one in every)
    if value.partition(" ")[0] != str(counted):
        raise source.refuse(f"{what}: {value}", f"the episodes above it are {counted}")


PROGRAMS: tuple[Program, ...] = (
    Program(
        name="lerobot-eval",
        file="eval_info.json",
        keys=frozenset({"per_task", "overall"}),
        read_json=_lerobot,
    ),
    Program(
        name="allenai's vla-evaluation-harness",
        file="result of a benchmark, or its …_aggregate.json",
        keys=frozenset({"benchmark", "harness_version", "tasks"}),
        read_json=_allenai,
    ),
    Program(
        name="official MIKASA-Robo-VLA runner",
        file="ENV_ID.json",
        keys=frozenset({"env_id", "successes", "episode_seeds"}),
        read_json=_official,
    ),
    Program(
        name="inspect_ai",
        file="log, as `inspect eval --log-format json` writes it",
        keys=frozenset({"version", "eval", "plan", "samples"}),
        read_json=_inspect_ai,
    ),
    Program(
        name="inspect-robots",
        file="log (JSON)",
        keys=frozenset({"version", "eval", "samples"}),
        read_json=_inspect_robots,
    ),
    Program(
        name="robostats",
        file="records (JSON Lines)",
        is_text=lambda text: text.startswith("{") and '"policy_id"' in text.partition("\n")[0],
        read_text=_robostats,
    ),
    Program(
        name="openvla-oft",
        file="log of run_libero_eval.py",
        is_text=lambda text: "# episodes completed so far: " in text,
        read_text=_openvla_oft,
    ),
)
