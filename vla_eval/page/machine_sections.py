"""The page's sections on time, errors, videos, how a run was made and how to reproduce it."""

import base64
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from vla_eval.page.material import Material
from vla_eval.page.tables import page_table
from vla_eval.records import EpisodeRecord
from vla_eval.results.notes import UNCOMMITTED, has_uncommitted_changes
from vla_eval.results.passport.passport import merged
from vla_eval.results.printed_table import UNDEFINED, PrintedTable
from vla_eval.results.side_by_side.written import passport_table
from vla_eval.storage.capture_files import thumbnail_file, video_file
from vla_eval.storage.run_file import JsonValue, leaves
from vla_eval.storage.run_folder import StoredRun
from vla_eval.storage.timings import measure_latency
from vla_eval.tasks.objects.item_names import item_names

MAX_SHOWN_VIDEOS = 12
MAX_VIDEO_BYTES = 16_000_000  # in total: a page has to open fast and fit into a mail
MAX_MESSAGE = 400  # characters of an error's message


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencyTable:
    """Times of inferences; `n_unknown` rows have no timing."""

    table: PrintedTable
    n_unknown: int


def passport(material: Material) -> PrintedTable:
    """Return how the rows were made; where they differ, each value once."""
    return passport_table([merged(list(material.table.passports.values()), subject="value")])


def latency(material: Material) -> LatencyTable:
    """Return times of inferences by task, policy, K and run."""
    rows: list[tuple[tuple[int, int, int], list[str]]] = []
    n_unknown = 0
    records = [record for run in material.runs for record in run.records]
    tasks = list(dict.fromkeys(record.task for record in records))
    policies = list(dict.fromkeys(record.policy for record in records))
    several_tasks = len(material.tasks) > 1
    for run in material.runs:
        results = [record for record in run.records if record.outcome != "error"]
        for group in dict.fromkeys(record.key[:3] for record in results):
            own = [record for record in results if record.key[:3] == group]
            measured = measure_latency(own, material.timings[str(run.path)])
            if measured is None:
                n_unknown += 1
                continue
            task, policy, size = group
            seconds = (measured.median_seconds, measured.slowest_seconds)
            place = (tasks.index(task), policies.index(policy), size)
            row = [
                f"{task} · {policy} · K={size}" if several_tasks else f"{policy} · K={size}",
                str(run.path),
                str(measured.n_episodes),
                *(f"{value * 1000:.2f}" for value in seconds),
                f"{measured.episode_seconds:.2f}",
            ]
            rows.append((place, row))
    times = ("ms per inference, median", "slowest episode", "s per episode, median")
    rows.sort(key=lambda one: one[0])  # stable: runs stay in their order
    table = page_table([row for _, row in rows], text=("policy", "run"), numbers=("episodes", *times))
    return LatencyTable(table=table, n_unknown=n_unknown)


def errors_table(material: Material) -> PrintedTable:
    """Return errors by cause, the most frequent first."""
    runs = (run for row in material.table.rows for run in row.episodes.runs)
    records = (record for run in runs for record in run.records.values())
    errors = [(record, record.error) for record in records if record.error is not None]
    counts = Counter((error.kind, error.stage) for _, error in errors)
    rows = []
    for (kind, stage), n in counts.most_common():
        record, error = next(one for one in errors if (one[1].kind, one[1].stage) == (kind, stage))
        where = f"{record.policy} on {record.task}, seed {record.seed}"
        rows.append([kind, stage, str(n), f"{where}: {error.message[:MAX_MESSAGE]}"])
    return page_table(rows, text=("kind", "during"), numbers=("episodes",), code=("the first of them",))


@dataclass(frozen=True, slots=True, kw_only=True)
class Video:
    """A captured episode: video and thumbnail as `data:` URIs, and what is seen in them."""

    name: str
    src: str
    poster: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Videos:
    """The videos that fit into the page, of `n_captured` in `folders`."""

    shown: tuple[Video, ...]
    n_captured: int
    folders: str


class _Captured(NamedTuple):
    run: StoredRun
    record: EpisodeRecord
    video: Path


def videos(material: Material) -> Videos:
    """Select videos: one of each row and outcome in turn, until the page is full."""
    captured = [
        _Captured(run, record, video_file(run.path, record))
        for run in material.runs
        for record in run.records
        if video_file(run.path, record).is_file()
    ]
    shown: list[Video] = []
    n_bytes = 0
    for one in _in_turn(captured):
        size = one.video.stat().st_size
        if len(shown) < MAX_SHOWN_VIDEOS and n_bytes + size <= MAX_VIDEO_BYTES:
            shown.append(_video(one))
            n_bytes += size
    folders = ", ".join(dict.fromkeys(str(one.video.parent) for one in captured))
    return Videos(shown=tuple(shown), n_captured=len(captured), folders=folders)


def _in_turn(captured: list[_Captured]) -> list[_Captured]:
    """Return the first of each row and outcome, then the second of each, and so on."""
    seen: Counter[tuple[object, ...]] = Counter()
    ranks = []
    for one in captured:
        kind = (*one.record.key[:3], one.record.outcome)
        ranks.append(seen[kind])
        seen[kind] += 1
    order = sorted(range(len(captured)), key=lambda i: ranks[i])
    return [captured[i] for i in order]


def _video(one: _Captured) -> Video:
    record = one.record
    name = (
        f"{record.task} · {record.policy} · K={record.n_action_steps} · seed {record.seed}: {record.outcome}"
    )
    if record.n_candidates:
        names = item_names(record.task, record.n_candidates, given=record.candidate_names)
        chosen = "none" if record.first_choice is None else names[record.first_choice]
        name += f", target {UNDEFINED if record.target is None else names[record.target]}, chosen {chosen}"
    thumbnail = thumbnail_file(one.run.path, record)
    poster = _data_uri("image/jpeg", thumbnail) if thumbnail.is_file() else None
    return Video(name=name, src=_data_uri("video/mp4", one.video), poster=poster)


def _data_uri(kind: str, path: Path) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


class Listing(NamedTuple):
    """Names and values behind a title; without any, `missing` says so."""

    title: str
    table: PrintedTable
    missing: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Reproduction:
    """What is needed to reproduce a run."""

    title: str
    commands: str  # from the checkout to the last session; empty if none was recorded
    lock: str  # versions of packages, and digests of all that the results depend on
    warning: str  # why the commands may not be enough; may be empty
    listings: tuple[Listing, ...]
    config: str
    environment_changes: str  # how the machine or the versions changed between sessions


def reproduction(run: StoredRun) -> Reproduction:
    """Return commands, configuration, hashes and environment of a run."""
    description = run.description
    commands = [session.command for session in run.sessions if session.command] or [description.command]
    changes = [str(change) for session in run.sessions for change in session.environment_changes]
    statistics = dict(leaves(description.normalization, prefix=""))
    environment = dict(leaves(description.environment, prefix=""))
    return Reproduction(
        title=f"{run.path} ({description.name})",
        commands="\n".join([*_setup_commands(description.environment), *commands]) if any(commands) else "",
        lock="\n".join(_lock(run)),
        warning=UNCOMMITTED.capitalize() if has_uncommitted_changes(description.environment) else "",
        listings=(
            _listing("Recipes, sha256", dict(description.recipes), "No recipe hashes were recorded."),
            _listing("Normalization statistics", statistics, "No policy of this run normalises."),
            _listing("Environment", environment, "No environment was recorded."),
        ),
        config=json.dumps(description.config, indent=2, ensure_ascii=False, default=str),
        environment_changes="; ".join(changes),
    )


def _setup_commands(environment: Mapping[str, JsonValue]) -> list[str]:
    """Return how to get the code and the versions that the run was made with."""
    source = environment.get("vla_eval")
    source = source if isinstance(source, Mapping) else {}
    if isinstance(commit := source.get("commit"), str):
        return [f"git checkout {commit}", "make setup    # the versions of constraints.txt", ""]
    if isinstance(version := source.get("version"), str):
        return [f"# mikasa-vla-eval {version}; its commit was not recorded", ""]
    return []


def _lock(run: StoredRun) -> list[str]:
    """Return versions as pip takes them, then digests as `sha256sum` prints them."""
    environment = run.description.environment
    packages = environment.get("packages")
    packages = packages if isinstance(packages, Mapping) else {}
    python = environment.get("python")
    return [
        *([f"# Python {python}"] if python is not None else []),
        *(f"{name}=={version}" for name, version in packages.items() if version is not None),
        *(["# sha256"] if run.description.recipes else []),
        *(f"{digest}  {name}" for name, digest in run.description.recipes.items()),
    ]


def _listing(title: str, values: dict[str, str], missing: str) -> Listing:
    rows = [[name, value] for name, value in values.items()]
    return Listing(title, page_table(rows, text=("name",), code=("value",)), missing)
