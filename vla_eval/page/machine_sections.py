"""The sections of the report page on time, errors, recordings and how to do it all again."""

import base64
import json
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from vla_eval.page.markup import UNKNOWN, Markup, details, element, joined, paragraph, section, table
from vla_eval.page.material import Material, errors_of
from vla_eval.results.recording_files import thumbnail_file, video_file
from vla_eval.results.records import EpisodeRecord
from vla_eval.results.run_file import leaves
from vla_eval.results.store import StoredRun
from vla_eval.results.timings import measure_latency
from vla_eval.tasks.item_names import item_names

MAX_SHOWN_VIDEOS = 12
MAX_VIDEO_BYTES = 16_000_000  # all of them together: a page is to be opened, and sent by mail
MAX_MESSAGE = 400  # characters of an error's message


def latency_section(material: Material) -> Markup:
    """Show how long inferences took."""
    rows, n_unknown = _latency_rows(material)
    unknown = f"For {n_unknown} rows no timing was kept (timings.jsonl)." if n_unknown else ""
    if not rows:
        return section("latency", "Inference latency", paragraph(unknown or "No episode has a result yet."))
    times = ("ms per inference, median", "slowest episode", "s per episode, median")
    return section(
        "latency",
        "Inference latency",
        paragraph(
            "Wall-clock time on the machine named below, workers sharing its cores; per inference, an "
            "episode's mean. No result depends on it.",
            muted=True,
        ),
        table(("policy", "run", "episodes", *times), rows, numeric=[False, False, *[True] * 4]),
        paragraph(unknown, muted=True) if unknown else joined(()),
    )


def _latency_rows(material: Material) -> tuple[list[list[str]], int]:
    """Return a row for each run, task, policy and K, and for how many of these nothing is known."""
    rows, n_unknown = [], 0
    for run in material.runs:
        results = [record for record in run.records if record.outcome != "error"]
        for group in dict.fromkeys(record.key[:3] for record in results):
            own = [record for record in results if record.key[:3] == group]
            latency = measure_latency(own, material.timings[str(run.path)])
            if latency is None:
                n_unknown += 1
                continue
            task, policy, size = group
            seconds = (latency.median_seconds, latency.slowest_seconds)
            rows.append(
                [
                    f"{task} · {policy} · K={size}",
                    str(run.path),
                    str(latency.n_episodes),
                    *(f"{value * 1000:.2f}" for value in seconds),
                    f"{latency.episode_seconds:.2f}",
                ]
            )
    return rows, n_unknown


def errors_section(material: Material) -> Markup:
    """Show errors by cause."""
    errors = [record for record in errors_of(material) if record.error is not None]
    if not errors:
        return section("errors", "Errors by cause", paragraph("No episode ended in an error."))
    counts = Counter((r.error.kind, r.error.stage) for r in errors if r.error)
    rows = []
    for (kind, stage), n in counts.most_common():
        first = next(r for r in errors if r.error and (r.error.kind, r.error.stage) == (kind, stage))
        message = first.error.message[:MAX_MESSAGE] if first.error else ""
        rows.append(
            [
                kind,
                stage,
                str(n),
                element("code", f"{first.policy} on {first.task}, seed {first.seed}: {message}"),
            ]
        )
    return section(
        "errors",
        "Errors by cause",
        paragraph(
            "Errors are no failures: they are in no rate, and the same `eval` command runs them again.",
            muted=True,
        ),
        table(("kind", "during", "episodes", "the first of them"), rows, numeric=[False, False, True, False]),
    )


class _Recorded(NamedTuple):
    run: StoredRun
    record: EpisodeRecord
    video: Path


def episodes_section(material: Material) -> Markup:
    """Show videos of picked episodes: one of each row and outcome in turn, until there is no more room."""
    recorded = [
        _Recorded(run, record, video_file(run.path, record))
        for run in material.runs
        for record in run.records
        if video_file(run.path, record).is_file()
    ]
    if not recorded:
        said = "No videos were recorded. `mikasa-vla eval … --record-video failures` records some."
        return section("episodes", "Episodes", paragraph(said))
    shown: list[Markup] = []
    n_bytes = 0
    for one in _in_turn(recorded):
        size = one.video.stat().st_size
        if len(shown) < MAX_SHOWN_VIDEOS and n_bytes + size <= MAX_VIDEO_BYTES:
            shown.append(_episode(one))
            n_bytes += size
    folders = ", ".join(dict.fromkeys(str(one.video.parent) for one in recorded))
    counted = f"{len(shown)} of {len(recorded)} recorded episodes; all of them are in {folders}."
    return section(
        "episodes", "Episodes", paragraph(counted, muted=True), element("div", *shown, class_="episodes")
    )


def _in_turn(recorded: list[_Recorded]) -> list[_Recorded]:
    """Return the first of each row and outcome, then the second of each, and so on."""
    seen: Counter[tuple[object, ...]] = Counter()
    ranks = []
    for one in recorded:
        kind = (*one.record.key[:3], one.record.outcome)
        ranks.append(seen[kind])
        seen[kind] += 1
    order = sorted(range(len(recorded)), key=lambda i: ranks[i])
    return [recorded[i] for i in order]


def _episode(one: _Recorded) -> Markup:
    record = one.record
    name = (
        f"{record.task} · {record.policy} · K={record.n_action_steps} · seed {record.seed}: {record.outcome}"
    )
    choice = ""
    if record.n_candidates:
        names = item_names(record.task, record.n_candidates)
        chosen = "none" if record.first_choice is None else names[record.first_choice]
        choice = f", target {UNKNOWN if record.target is None else names[record.target]}, chosen {chosen}"
    thumbnail = thumbnail_file(one.run.path, record)
    poster = _data_uri("image/jpeg", thumbnail) if thumbnail.is_file() else None
    video = element(
        "video",
        controls=True,
        preload="metadata",
        poster=poster,
        src=_data_uri("video/mp4", one.video),
        aria_label=f"Video: {name}{choice}",
    )
    return element("figure", video, element("figcaption", name, choice))


def _data_uri(kind: str, path: Path) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def reproduction_section(material: Material) -> Markup:
    """Show commands, configuration, hashes and environment of each run."""
    return section(
        "reproduce", "To do it again", *(part for run in material.runs for part in _reproduction(run))
    )


def _reproduction(run: StoredRun) -> list[Markup]:
    description = run.description
    commands = [session.command for session in run.sessions if session.command] or [description.command]
    config = json.dumps(description.config, indent=2, ensure_ascii=False, default=str)
    parts = [
        element("h3", f"{run.path} ({description.name})"),
        element("pre", "\n".join(commands)) if any(commands) else paragraph("The command was not recorded."),
        _listing("Recipes, sha256", dict(description.recipes), "No recipe hashes were recorded."),
        _listing(
            "Statistics that normalise",
            dict(leaves(description.normalization, prefix="")),
            "No policy of this run normalises.",
        ),
        _listing(
            "Environment", dict(leaves(description.environment, prefix="")), "No environment was recorded."
        ),
        details("Configuration as resolved", element("pre", config)),
    ]
    changes = [str(change) for session in run.sessions for change in session.environment_changes]
    if changes:
        parts.append(paragraph("It was continued in another environment: " + "; ".join(changes)))
    return parts


def _listing(title: str, values: dict[str, str], missing: str) -> Markup:
    if not values:
        return paragraph(missing)
    shown = table(
        ("name", "value"),
        [[name, element("code", value)] for name, value in values.items()],
        numeric=[False, False],
    )
    return details(title, shown)
