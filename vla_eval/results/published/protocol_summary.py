"""The summary figures of a published protocol, where nothing departs from it; else what departs."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import to_data
from vla_eval.config.protocol import Protocol, load_protocol
from vla_eval.config.recorded_chunking import recorded_chunking
from vla_eval.errors import RecipeError, UnknownNameError, some_of
from vla_eval.results.estimates import estimate_runs, mean_interval
from vla_eval.results.grouping import Grouping, RowEpisodes, RowKey
from vla_eval.results.passport.fields import setting_sections
from vla_eval.results.passport.settings import task_version
from vla_eval.results.success_table import ProtocolRow
from vla_eval.storage.run_file import leaves
from vla_eval.storage.run_folder import StoredRun


class Summaries(NamedTuple):
    """Summary figures of one or more protocols, and notes on them."""

    rows: tuple[ProtocolRow, ...]
    notes: tuple[str, ...]


def protocol_summaries(runs: Sequence[StoredRun], grouping: Grouping, *, names: Sequence[str]) -> Summaries:
    """Return the figures of protocols asked for, errors as `load_protocol`, and of those the runs name."""
    wanted = {name: load_protocol(name).value for name in names}
    notes = []
    for name in dict.fromkeys(name for run in runs if (name := named_protocol(run)) is not None):
        if name in wanted:
            continue
        try:
            wanted[name] = load_protocol(name).value
        except (UnknownNameError, RecipeError) as exc:  # the table itself needs no protocol
            notes.append(f"no summary figure of the protocol {name}, which the runs name: {exc}")
    rows = tuple(row for protocol in wanted.values() for row in summarize(protocol, grouping))
    return Summaries(rows, tuple(notes))


def named_protocol(run: StoredRun) -> str | None:
    """Return the protocol that a run was started or last resumed under; None without one."""
    options = run.sessions[-1].options if run.sessions else run.description.options
    name = options.get("protocol")
    return name if isinstance(name, str) else None


def summarize(protocol: Protocol, grouping: Grouping) -> tuple[ProtocolRow, ...]:
    """Return the summary figures of a protocol for all policies that were run on any of its tasks."""
    by_label: dict[RowKey, dict[str, RowEpisodes]] = {}
    for key, group in grouping.groups.items():
        if key.task in protocol.tasks:
            by_label.setdefault(key.of_all_tasks, {})[key.task] = group
    parts: list[tuple[str | None, tuple[str, ...]]] = [*protocol.groups.items()]
    parts = parts or [(None, tuple(protocol.tasks))]
    return tuple(
        _row(protocol, part, label, {task: found[task] for task in tasks if task in found}, tasks, grouping)
        for label, found in by_label.items()
        for part, tasks in parts
        if any(task in found for task in tasks)
    )


def _row(
    protocol: Protocol,
    part: str | None,
    label: RowKey,
    found: Mapping[str, RowEpisodes],
    tasks: Sequence[str],
    grouping: Grouping,
) -> ProtocolRow:
    departures = (
        *_departures(protocol, label, found, tasks),
        *_setting_departures(protocol, found, grouping),
    )
    row = ProtocolRow(
        protocol=protocol.name,
        version=protocol.version,
        group=part,
        policy=label.policy,
        n_action_steps=label.n_action_steps,
        variant=label.variant,
        n_tasks=len(found),
        n_runs=max(len(group.runs) for group in found.values()),
        departures=departures,
    )
    return row if departures else _with_figure(row, list(found.values()))


def _with_figure(row: ProtocolRow, groups: Sequence[RowEpisodes]) -> ProtocolRow:
    """Return the row with its figure; every task has the same runs and seeds."""
    rates = [{run.key: run.rate for run in group.runs} for group in groups]
    estimate = estimate_runs([math.fsum(rate[key] for rate in rates) / len(rates) for key in rates[0]])
    assert estimate is not None  # no departure: each task has a run
    # Of one run, or of several without a spread: from the episodes of one run of each task.
    counts = [(group.runs[0].n_success, len(group.runs[0].results)) for group in groups]
    interval = estimate.interval if estimate.sem else mean_interval(counts)
    assert interval is not None
    of_tasks = [math.fsum(rate.values()) / len(rate) for rate in rates]
    return replace(
        row,
        mean=estimate.mean,
        ci_low=interval.low,
        ci_high=interval.high,
        interval="t_over_runs" if estimate.sem else "wilson_over_tasks",
        sem=estimate.sem,
        lowest=min(of_tasks),
        highest=max(of_tasks),
    )


def _departures(
    protocol: Protocol, label: RowKey, found: Mapping[str, RowEpisodes], tasks: Sequence[str]
) -> Iterator[str]:
    """Yield missing and additional tasks, K, runs and seeds."""
    absent = [task for task in tasks if task not in found]
    if absent:
        yield f"{len(found)} of {len(tasks)} tasks, without {some_of(absent)}"
    allowed = protocol.n_action_steps
    if allowed is not None and label.n_action_steps not in allowed:
        yield f"K={label.n_action_steps} instead of {some_of(allowed)}"
    yield from _run_departures(protocol, found)
    seeds: dict[str, list[str]] = {}
    for task, group in found.items():
        for text in _seed_departures(protocol, group):
            seeds.setdefault(text, []).append(task)
    for text, places in seeds.items():
        yield text if len(places) == len(found) else f"{text} in {some_of(places)}"


def _run_departures(protocol: Protocol, found: Mapping[str, RowEpisodes]) -> Iterator[str]:
    runs_of = {task: {run.key for run in group.runs} for task, group in found.items()}
    counts = sorted({len(runs) for runs in runs_of.values()})
    if protocol.runs is not None and counts != [protocol.runs]:
        yield f"{some_of(counts)} of {protocol.runs} runs"
    elif len({frozenset(runs) for runs in runs_of.values()}) > 1:
        yield "other runs in one task than in another"
    weights = [[run.weights for run in group.runs if run.weights] for group in found.values()]
    if protocol.runs is not None and any(len(set(of_task)) < len(of_task) for of_task in weights):
        yield f"the same weights in several runs instead of {protocol.runs} training runs"


def _seed_departures(protocol: Protocol, group: RowEpisodes) -> Iterator[str]:
    wanted = set(protocol.seeds)
    n_errors, fewest, n_others = group.n_errors, len(wanted), 0
    for run in group.runs:
        fewest = min(fewest, len(wanted & run.results.keys()))
        n_others = max(n_others, len(run.results.keys() - wanted))
    if fewest < len(wanted):
        errors = f" ({n_errors} errors)" if n_errors else ""
        yield f"{fewest} of {len(wanted)} seeds{errors}"
    if n_others:
        yield f"{n_others} seeds outside of {protocol.seeds[0]} to {protocol.seeds[-1]}"


def _setting_departures(
    protocol: Protocol, found: Mapping[str, RowEpisodes], grouping: Grouping
) -> Iterator[str]:
    """Yield the settings and task versions that are not the protocol's, as the run folders have them."""
    texts: dict[str, None] = {}
    for task, group in found.items():
        for run in grouping.folders[group.key]:
            texts.update(dict.fromkeys(_settings(protocol, run)))
            version = task_version(run, task)
            if version != protocol.tasks[task]:
                known = "unknown version" if version is None else f"version {version}"
                texts[f"{task} of {known} instead of {protocol.tasks[task]}"] = None
    yield from texts


def _settings(protocol: Protocol, run: StoredRun) -> Iterator[str]:
    default = EvalConfig(name="defaults", tasks=("any",), policies=("any",))
    defaults = to_data(default)
    defaults["chunking"] = recorded_chunking(default.chunking, defaults["chunking"])
    config = run.description.config
    sections = setting_sections()
    expected = dict(leaves({name: defaults[name] for name in sections}, prefix=""))
    # A field that a run does not name had its default in the version that wrote it.
    own = dict(leaves({name: config[name] for name in sections if name in config}, prefix=""))
    for path, text in own.items():
        if text != expected.get(path) and not protocol.is_free(path):
            yield f"{path}={text.strip('"')}"
