"""Results in a model card: the `model-index` that the Hugging Face Hub reads, written and read.

huggingface_hub knows the format; ours is which row is which result. Only local files are read.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # YAML

from huggingface_hub import EvalResult, ModelCard, ModelCardData

from vla_eval.errors import ReportError, some_of
from vla_eval.results.latex_preset import CONTROLS
from vla_eval.results.passport.fields import SETTINGS
from vla_eval.results.success_table import Row, Table

CARD = "README.md"
TASK_TYPE, TASK_NAME = "robotics", "memory-intensive manipulation"
# The package joins results of one dataset type and configuration, so that the type has the task.
DATASET, METRIC = "mikasa-robo/", "success_once"
K = "K="


@dataclass(frozen=True, slots=True, kw_only=True)
class CardResult:
    """One result of a card: so many successes on a task at a K, and how it was measured, in words."""

    task: str
    n_action_steps: int | None
    n_success: int
    n_episodes: int
    settings: dict[str, str]


def with_results(text: str, table: Table, *, where: str) -> str:
    """Return a model card with the rows of a table in its `model-index`; results of other kinds stay.

    Args:
        text: the card, with or without metadata; it may be empty.
        table: rows of one policy, besides scripted controls, which are left out.
        where: the file, for messages.

    Raises:
        ReportError: the rows are of several policies or of none, or the card cannot be read.
    """
    rows = [row for row in table.rows if row.key.policy not in CONTROLS and row.episodes.results]
    policies = sorted({row.key.policy for row in rows})
    if len(policies) != 1:
        raise ReportError(
            f"{where}: a card is of one policy; expected rows of one, found {some_of(policies) or 'none'}. "
            "Evaluate it in a run of its own, with controls."
        )
    card = _card(text, where=where)
    data, new = _data(card), [_result(row, table) for row in rows]
    others = [one for one in data.eval_results or [] if _key(one) not in {_key(own) for own in new}]
    data.eval_results = [*others, *new]
    data.model_name = data.model_name or policies[0]
    return str(card)


def results_of_card(path: Path) -> list[CardResult]:
    """Return the results of ours in a card, a file or the folder that it lies in.

    Raises:
        ReportError: it cannot be read, or a result has no counts.
    """
    file = path / CARD if path.is_dir() else path
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise ReportError(f"{file}: expected a model card, found {exc}.") from exc
    return list(_read(_data(_card(text, where=str(file))).eval_results or [], where=str(file)))


def _card(text: str, *, where: str) -> ModelCard:
    has_metadata = text.lstrip().startswith("---")  # else the package warns
    try:
        card = ModelCard(text if has_metadata else f"---\n{{}}\n---\n{text}")
    except Exception as exc:  # whatever the parsers of the package raise
        raise ReportError(f"{where}: expected a model card, found {type(exc).__name__}: {exc}") from exc
    return card


def _data(card: ModelCard) -> ModelCardData:
    assert isinstance(card.data, ModelCardData)  # of a `ModelCard`
    return card.data


def _result(row: Row, table: Table) -> EvalResult:
    values, passport = row.to_dict(), table.passports[row.key]
    variant = f", {row.key.variant}" if row.key.variant else ""
    counts = ("n_success_once", "n_episodes", "n_errors", "n_runs", "ci_low", "ci_high", "chance")
    return EvalResult(
        task_type=TASK_TYPE,
        task_name=TASK_NAME,
        dataset_type=f"{DATASET}{row.key.task}",
        dataset_name=row.key.task,
        dataset_config=f"{K}{row.key.n_action_steps}{variant}",
        dataset_args={one.name: passport.text(one.name) for one in SETTINGS},
        metric_type=METRIC,
        metric_name="success once",
        metric_value=values["success_once"],
        metric_args={name: values[name] for name in counts},
    )


def _key(result: EvalResult) -> tuple[object, ...]:
    return (result.dataset_type, result.dataset_name, result.dataset_config, result.metric_type)


def _read(results: list[EvalResult], *, where: str) -> Iterator[CardResult]:
    for one in results:
        if not str(one.dataset_type).startswith(DATASET) or one.metric_type != METRIC:
            continue
        counts = one.metric_args if isinstance(one.metric_args, dict) else {}
        n_success, n_episodes = _count(counts, "n_success_once"), _count(counts, "n_episodes")
        if n_success is None or n_episodes is None:
            raise ReportError(
                f"{where}: {one.dataset_name}: expected the counts n_success_once and n_episodes among the "
                f"metric's args, found {counts or 'none'}. `mikasa-vla report --card` writes them."
            )
        config = str(one.dataset_config or "").partition(",")[0]
        steps = config.removeprefix(K)
        settings = one.dataset_args if isinstance(one.dataset_args, dict) else {}
        yield CardResult(
            task=str(one.dataset_name),
            n_action_steps=int(steps) if config.startswith(K) and steps.isdecimal() else None,
            n_success=n_success,
            n_episodes=n_episodes,
            settings={str(name): str(value) for name, value in settings.items()},
        )


def _count(counts: dict[str, Any], name: str) -> int | None:
    value = counts.get(name)
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None
