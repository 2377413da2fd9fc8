"""What a grid says, in words: which drops chunk and phase explain, and which they do not."""

from vla_eval.probe.grid_table import GridCell, GridTable
from vla_eval.probe.text_table import error_notes


def grid_sentences(table: GridTable) -> list[str]:
    """Return a sentence for each cell in which a policy succeeds less than in its best cell."""
    by_policy: dict[tuple[str, str, str], list[GridCell]] = {}
    for cell in table.cells:
        if cell.reference is not None and cell.rate is not None:
            by_policy.setdefault((cell.task, cell.axis, cell.policy), []).append(cell)
    found = []
    for cells in by_policy.values():
        best = max(cells, key=lambda cell: cell.rate or 0.0)
        found += [sentence for cell in cells if (sentence := _sentence(table, cell, best)) is not None]
    return found


def _sentence(table: GridTable, cell: GridCell, best: GridCell) -> str | None:
    now, at_best = table.reference_of(cell), table.reference_of(best)
    if not _is_below(cell, best) or now is None or at_best is None:
        return None
    drop = f"succeeds in {_rate(cell)} at {_where(cell)}, and in {_rate(best)} at {_where(best)}"
    rates = f"succeeds in {_rate(now)} and {_rate(at_best)}: chunk and phase"
    if not _is_below(now, at_best):
        said = f"{rates} do not explain the drop"
    elif _is_below(cell, now):
        said = f"{rates} explain a part of the drop, not all of it"
    else:
        said = (
            f"falls, too, from {_rate(at_best)} to {_rate(now)}: chunk and phase alone explain the drop, not "
            "memory"
        )
    same = f"{now.policy}, which has the same inferences and forgets nothing,"
    return f"{cell.policy} on {cell.task} {drop}; {same} {said}."


def _is_below(one: GridCell, other: GridCell) -> bool:
    """Whether the intervals of two rates do not overlap, and the first rate is the lower one."""
    if one.interval is None or other.interval is None:
        return False
    return one.interval.high < other.interval.low


def _where(cell: GridCell) -> str:
    return f"K = {cell.n_action_steps}, {cell.axis} {cell.level}"


def _rate(cell: GridCell) -> str:
    return "no episode" if cell.rate is None else f"{cell.rate:.2f}"


def grid_notes(table: GridTable) -> list[str]:
    """Return the notes that a reader of the table needs, errors included."""
    found = [
        "Success once, over all first inferences; 95 % intervals (Wilson) count a seed as one episode. cue "
        "frames: how many the policy is given (oracle reads the true state). late: steps of the response "
        "before its first inference, whose actions were chosen before it. Each from the least to the most "
        "over the first inferences.",
    ]
    controls = dict.fromkeys(cell.reference for cell in table.cells if cell.reference is not None)
    if controls:
        found.append(
            "Same inferences: cue_reader for a policy that reads only the last frame (it knows what was in "
            "view at its own inferences, and guesses the rest); oracle for one that reads every frame."
        )
    unknown = dict.fromkeys(
        cell.policy for cell in table.cells if any(part.n_seen is None for part in cell.parts)
    )
    found += [f"{name}: no episode has a result, so that what it reads is not known." for name in unknown]
    return [*found, *error_notes(table.n_errors)]
