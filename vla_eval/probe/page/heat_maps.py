"""The heat maps of a grid: success by K and by the length of a phase."""

from pathlib import Path

from vla_eval.page.heat import HeatMap, heat_png
from vla_eval.probe.grid import AXES
from vla_eval.probe.grid_table import GridCell, GridTable
from vla_eval.probe.page.png_files import write_beside

Group = tuple[str, str]
"""Task, and phase or mode."""


def heat_maps(table: GridTable) -> dict[Group, list[HeatMap]]:
    """Return the heat maps of each task and phase: of the policies, then of the controls."""
    found: dict[Group, dict[str, list[GridCell]]] = {}
    for cell in table.cells:
        group = f"{cell.axis}, {cell.mode}" if cell.axis == "latency" else cell.axis
        found.setdefault((cell.task, group), {}).setdefault(cell.policy, []).append(cell)
    return {
        group: [_heat_map(policy, cells) for policy, cells in policies.items()]
        for group, policies in found.items()
    }


def write_heat_maps(table: GridTable, folder: Path) -> list[Path]:
    """Write a PNG file per task and phase, next to the folder of runs, and return their paths."""
    found = heat_maps(table)
    names = {key: "_".join(key).replace(", ", "_") for key in found}
    return write_beside(folder, {names[key]: heat_png(maps) for key, maps in found.items()})


def _heat_map(policy: str, cells: list[GridCell]) -> HeatMap:
    sizes = sorted({cell.n_action_steps for cell in cells})
    levels = sorted({cell.level for cell in cells})
    rates = {(cell.n_action_steps, cell.level): cell.rate for cell in cells}
    return HeatMap(
        title=policy,
        row_title="K",
        column_title=f"{AXES[cells[0].axis]}, steps",
        rows=tuple(sizes),
        columns=tuple(levels),
        rates=tuple(tuple(rates.get((k, level)) for level in levels) for k in sizes),
    )
