"""Write a table as a paper has it: LaTeX, tasks as columns, policies as rows, the best policy in bold."""

import re
from collections.abc import Collection, Mapping, Sequence

from vla_eval.results.comparison import Success, compare
from vla_eval.results.estimates import LEVEL
from vla_eval.results.grouping import RowEpisodes, RowKey
from vla_eval.results.latex import latex_first, latex_text
from vla_eval.results.own_statistics import EPISODES, SUCCESS
from vla_eval.results.passport.ranking import NOT_RANKED
from vla_eval.results.relative_statistics import BY_ARITHMETIC, CHANCE, against_chance
from vla_eval.results.success_table import Row, Table

CONTROLS = {
    "oracle": "the scripted arm that knows the answer",
    "cue_blind": "the same arm without the cue",
    "random": "random actions",
    "hold": "no motion",
    "tour": "one candidate after another",
    "cue_reader": "the cue as far as inferences fall into it",
    "body_memory": "the cue stored in the gripper",
    "cue_touch": "stays where the cue was",
    "one_frame": "single frames",
}
"""Scripted policy -> its words in a caption. They are below the rule and never the best."""
LINE_WIDTH_PT = 345  # \linewidth of LaTeX's article with 10 pt
SMALL_PT, SCRIPT_PT = 5.0, 3.9  # width of a letter in \small and \scriptsize, which are 9 and 7 pt high
COLUMN_SPACE_PT = 6  # twice \tabcolsep
LONGEST_LINE = 10  # letters in a line of a column's title
CHANCE_NAME = "chance, 1/N"


def paper_preset(table: Table) -> str:
    """Return a `table` environment of one line width, in blocks below each other; it needs booktabs."""
    tasks = list(dict.fromkeys(row.task for row in table.rows))
    labels = dict.fromkeys(row.key.of_all_tasks for row in table.rows)
    names = {label: _name(label, list(labels), table.variants) for label in labels}
    cells = {(row.key.of_all_tasks, row.task): row for row in table.rows}
    best = _best(table)
    width = max([len(CHANCE_NAME), *map(len, names.values())]) * SMALL_PT + COLUMN_SPACE_PT
    n_side_by_side = max(1, int((LINE_WIDTH_PT - width) / _cell_width_pt(table.rows, tasks)))
    blocks = [tasks[i : i + n_side_by_side] for i in range(0, len(tasks), n_side_by_side)]
    slug = re.sub("[^a-z0-9]+", "-", "-".join(dict.fromkeys(table.runs.values())).lower()).strip("-")
    lines = [
        "% needs \\usepackage{booktabs}",
        "\\begin{table}[t]",
        "\\centering",
        f"\\caption{{{_caption(table)}}}",
        f"\\label{{tab:{slug or 'results'}}}",
        "\\smallskip",
        "\\small",
        f"\\setlength{{\\tabcolsep}}{{{COLUMN_SPACE_PT / 2:g}pt}}",
    ]
    for number, block in enumerate(blocks):
        lines += [*(["", "\\medskip"] if number else []), *_tabular(block, names, cells, best)]
    return "\n".join([*lines, "\\end{table}"])


def _tabular(
    tasks: Sequence[str],
    names: dict[RowKey, str],
    cells: dict[tuple[RowKey, str], Row],
    best: Collection[RowKey],
) -> list[str]:
    lines = [f"\\begin{{tabular}}{{@{{}}l{'c' * len(tasks)}@{{}}}}", "\\toprule"]
    titles = [_title(task) for task in tasks]
    height = max(map(len, titles))
    for i in range(height):
        # Titles end in the same line.
        parts = [title[i - height + len(title)] if i >= height - len(title) else "" for title in titles]
        lines.append(" & ".join(["", *map(latex_text, parts)]) + r" \\")
    learned = [label for label in names if label.policy not in CONTROLS]
    controls = [label for label in names if label.policy in CONTROLS]
    for group in (learned, controls):
        lines += ["\\midrule"] if group else []
        for label in group:
            found = [cells.get((label, task)) for task in tasks]
            if not any(found):  # it is in another block
                continue
            lines += _row(names[label], found, [row is not None and row.key in best for row in found])
    by_luck = [_by_luck(task, cells) for task in tasks]
    if any(by_luck):
        lines += [] if controls else ["\\midrule"]
        lines.append(" & ".join([latex_text(CHANCE_NAME), *(one or "---" for one in by_luck)]) + r" \\")
    return [*lines, "\\bottomrule", "\\end{tabular}"]


def _row(name: str, rows: Sequence[Row | None], is_best: Sequence[bool]) -> list[str]:
    """Return a line of rates, and below it a line of their intervals."""
    rates, intervals = [], []
    for row, best in zip(rows, is_best, strict=True):
        success = Success() if row is None else row[SUCCESS]
        if success.success_once is None:
            rates.append("---")
            intervals.append("")
            continue
        rate = f"{success.success_once:.2f}"
        rates.append(f"\\textbf{{{rate}}}" if best else rate)
        if success.sem is not None:
            rates[-1] += f" $\\pm$ {success.sem:.2f}"
        intervals.append(f"{{\\scriptsize [{success.ci_low:.2f}, {success.ci_high:.2f}]}}")
    return [
        latex_first(name) + "".join(f" & {rate}" for rate in rates) + r" \\",
        " & ".join(["", *intervals]) + r" \\[2pt]",
    ]


def _best(table: Table) -> set[RowKey]:
    """Return the best policy of each task and setting, if above chance and, by paired tests, unlike the next.

    Rows whose passports differ in a setting are not ranked.
    """
    alike: dict[object, list[Row]] = {}
    for row in table.rows:
        if row.policy not in CONTROLS:
            alike.setdefault((row.task, table.passports[row.key].standing), []).append(row)
    pairs: dict[object, tuple[RowEpisodes, RowEpisodes]] = {}
    for place, learned in alike.items():
        rates = ((row[SUCCESS].success_once, row) for row in learned)
        known = [(rate, row) for rate, row in rates if rate is not None]
        ranked = sorted(known, key=lambda one: -one[0])
        if len(ranked) > 1 and ranked[0][0] > ranked[1][0] and _is_above_chance(ranked[0][1]):
            pairs[place] = (ranked[0][1].episodes, ranked[1][1].episodes)
    found = compare(pairs)
    return {pairs[place][0].key for place, one in found.items() if one.corrected_p < LEVEL}


def _is_above_chance(row: Row) -> bool:
    """Whether it is shown to be above chance; above an unknown chance, nothing can be shown."""
    compared, chance = against_chance(row), row[CHANCE]
    if compared is not None:
        return compared.corrected_p < LEVEL and compared.test.difference > 0
    low = row[SUCCESS].ci_low
    return chance is not None and low is not None and low > chance.rate


def _by_luck(task: str, cells: dict[tuple[RowKey, str], Row]) -> str | None:
    """Return chance by arithmetic, if that is what the rows of the task are compared with."""
    rates = {
        chance.rate
        for (_, other), row in cells.items()
        if other == task and (chance := row[CHANCE]) is not None and chance.source in BY_ARITHMETIC
    }
    return f"{rates.pop():.2f}" if len(rates) == 1 else None


def _name(label: RowKey, labels: Sequence[RowKey], variants: Mapping[str, str]) -> str:
    """Return the policy, its K if there are several, and the letter of its variant."""
    several = len({other.n_action_steps for other in labels}) > 1
    name = f"{label.policy}, K = {label.n_action_steps}" if several else label.policy
    return f"{name} ({variants[label.variant]})" if label.variant else name


def _title(task: str) -> list[str]:
    """Return the lines of a column's title: `RememberColor3-v0` gives `Remember`, `Color3`."""
    lines: list[str] = []
    for word in re.findall("[A-Z][^A-Z]*|[^A-Z]+", task.removesuffix("-v0")):
        if lines and len(lines[-1] + word) <= LONGEST_LINE:
            lines[-1] += word
        else:
            lines.append(word)
    return lines


def _cell_width_pt(rows: Sequence[Row], tasks: Sequence[str]) -> float:
    rate = len("0.00 ± 0.00") if any(row[SUCCESS].sem is not None for row in rows) else len("0.00")
    title = max(len(line) for task in tasks for line in _title(task))
    return max(max(rate, title) * SMALL_PT, len("[0.00, 0.00]") * SCRIPT_PT) + COLUMN_SPACE_PT


def _caption(table: Table) -> str:
    rows = [row for row in table.rows if row[SUCCESS].success_once is not None]
    first = "Success once with its 95\\,\\% interval"
    counts = sorted({row[EPISODES].n_episodes for row in rows})
    if counts:
        spread = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
        first += f", {spread} episodes per cell"
    sizes = {row.n_action_steps for row in rows}
    if len(sizes) == 1:
        first += f", $K = {sizes.pop()}$"
    sentences = [f"{first}."]
    if any(row[SUCCESS].sem is not None for row in rows):
        sentences.append("$\\pm$: standard error over the runs.")
    learned = {row.key.of_all_tasks for row in rows if row.policy not in CONTROLS}
    if len(learned) > 1:
        sentences.append(
            "Bold: the best policy of a task, where it is above chance and differs from the next one on the "
            f"same episodes (exact paired test, $p < {LEVEL:g}$ after Holm's correction)."
        )
        if any(note.startswith(NOT_RANKED) for note in table.notes):
            sentences.append("Rows with another $K$ or other settings are not ranked against each other.")
    controls = dict.fromkeys(row.policy for row in rows if row.policy in CONTROLS)
    if controls:
        said = "; ".join(f"{latex_text(name)}: {CONTROLS[name]}" for name in controls)
        sentences.append(f"Controls: {said}.")
    if table.variants:
        said = "; ".join(f"({letter}) {latex_text(text)}" for text, letter in table.variants.items())
        sentences.append(f"Settings: {said}.")
    n_errors = sum(row[EPISODES].n_errors for row in table.rows)
    if n_errors:
        sentences.append(f"Episodes that ended in an error are in no rate: {n_errors}.")
    return " ".join(sentences)
