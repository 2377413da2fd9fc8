"""The section of the report page on choices: what was right, what was chosen, and what went wrong."""

from vla_eval.page.markup import UNKNOWN, Markup, details, element, joined, paragraph, section, table
from vla_eval.page.material import Material
from vla_eval.results.choices import CAUSES, MOVED_M, Cause, ChoiceReport, Kind, report_choices
from vla_eval.tasks.item_names import item_names

TITLES: dict[Cause, str] = {
    "right": "right choice",
    "not_finished": "right choice, not finished",
    "forgot": "forgot",
    "position_habit": "position habit",
    "never_chose": "never chose",
    "could_not_move": "could not move",
}
EXPLANATIONS: dict[Cause, str] = {
    "right": "the first candidate touched was right, and the episode succeeded (by memory or by luck)",
    "not_finished": "the first candidate touched was right, but the task was not completed",
    "forgot": "a wrong candidate was touched first",
    "position_habit": "a wrong candidate was touched first, at the place that wrong choices prefer",
    "never_chose": "the arm moved but touched no candidate",
    "could_not_move": f"the arm was never {MOVED_M * 100:.0f} cm from where it began",
}
KIND_NAMES: dict[Kind, str] = {"item": "item", "place": "place (0 is the robot's rightmost)"}


def choices_section(material: Material) -> Markup:
    """Show for each row with candidates what came of the choice."""
    title = "Target and choice"
    reports = [(row, report_choices(material.group_of(row))) for row in material.table.rows]
    found = [(row, report) for row, report in reports if report is not None]
    if not found:
        said = "No task of this table has candidates to choose among, or no episode of one has a result."
        return section("choices", title, paragraph(said))
    rows = [
        [
            material.name_of(row, with_task=True),
            *(str(report.causes[cause]) for cause in CAUSES),
            _habit(report, "place", row.task),
            _habit(report, "item", row.task),
        ]
        for row, report in found
    ]
    titles = ["policy", *(TITLES[cause] for cause in CAUSES), "habit of place", "habit of item"]
    numeric = [False, *[True] * len(CAUSES), False, False]
    matrices = [
        details(material.name_of(row, with_task=True), *_matrices(report, row.task)) for row, report in found
    ]
    return section(
        "choices",
        title,
        element(
            "ul",
            *(element("li", element("b", TITLES[cause]), f": {EXPLANATIONS[cause]}.") for cause in CAUSES),
            class_="notes",
        ),
        paragraph(
            "Habit: whether wrong choices go to one place (or item) more often than 1/(N-1), the share if "
            "all wrong ones were alike; exact binomial test, p times N. A policy that guesses evenly has "
            "forgotten but has no habit.",
            muted=True,
        ),
        table(titles, rows, numeric=numeric, caption="Episodes by what came of the choice"),
        _missing([report for _, report in found]),
        *matrices,
    )


def _missing(reports: list[ChoiceReport]) -> Markup:
    said = []
    if not all(report.reach_is_known for report in reports):
        said.append(
            "Some records (of an earlier version) do not say how far the arm went: there, “could not move” "
            "cannot be told from “never chose”."
        )
    if any(not report.confusion["place"] and report.confusion["item"] for report in reports):
        said.append("Some records do not say where the candidates lay: there, no habit of place can be seen.")
    if any(not report.confusion["item"] for report in reports):
        said.append("Where several candidates are right at once there is no single target, and no matrix.")
    return joined(paragraph(text, muted=True) for text in said)


def _habit(report: ChoiceReport, kind: Kind, task: str) -> str:
    habit = report.habits[kind]
    if habit is None:
        return UNKNOWN
    if not habit.is_found:
        return f"not shown (p={habit.p_value:.2g})"
    share = f"{habit.n_chosen}/{habit.n_possible}"
    luck = f"{habit.by_luck:.2f} by luck, p={habit.p_value:.2g}"
    return f"{kind} {_names(report, kind, task)[habit.index]}: {share} of the wrong choices ({luck})"


def _matrices(report: ChoiceReport, task: str) -> list[Markup]:
    kinds: tuple[Kind, ...] = ("item", "place")
    drawn = [_matrix(report, kind, task) for kind in kinds if report.confusion[kind]]
    if not drawn:
        return [paragraph("No single target was recorded for these episodes.")]
    return [element("div", *drawn, class_="plots")]


def _names(report: ChoiceReport, kind: Kind, task: str) -> tuple[str, ...]:
    return item_names(task if kind == "item" else "", report.n_candidates)


def _matrix(report: ChoiceReport, kind: Kind, task: str) -> Markup:
    counts = report.confusion[kind]
    most = max(counts.values())
    names = _names(report, kind, task)
    chosen: list[int | None] = [*range(report.n_candidates), None]
    head = element(
        "tr",
        element("th", "target ↓ chosen →", scope="col"),
        *(element("th", "none" if i is None else names[i], scope="col") for i in chosen),
    )
    body = [
        element(
            "tr",
            element("th", names[target], scope="row"),
            *(_cell(counts.get((target, choice), 0), most, is_right=target == choice) for choice in chosen),
        )
        for target in range(report.n_candidates)
    ]
    caption = f"Episodes by {KIND_NAMES[kind]}: target (rows) and first choice (columns)"
    whole = element("table", element("caption", caption), element("thead", head), element("tbody", *body))
    return element("div", whole, class_="heat scroll", role="region", tabindex=0, aria_label=caption)


def _cell(n: int, most: int, *, is_right: bool) -> Markup:
    shade = f"background:rgba(var(--heat),{0.65 * n / most:.2f})" if n else None
    return element("td", str(n), style=shade, class_="right" if is_right else None)
