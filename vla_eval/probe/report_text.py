"""What `mikasa-vla report` prints of probes below its table: their tables, and pairs by choice."""

from collections.abc import Sequence

from vla_eval.probe.choice_pairs import ChoicePairs
from vla_eval.probe.find_worlds import find_probes
from vla_eval.probe.grid_text import render_grid
from vla_eval.probe.probe_text import render_probe
from vla_eval.results.cells import markdown_text
from vla_eval.results.printed_table import markdown_table
from vla_eval.storage.run_folder import StoredRun


def probe_texts(runs: Sequence[StoredRun]) -> list[str]:
    """Return Markdown for each probe and each grid among the run folders."""
    texts = []
    for probe in find_probes(runs):
        if probe.worlds:
            matrices = map(_pairs_text, probe.pairs())
            table = render_probe(probe.table(), "markdown")
            doubles = [f"- {markdown_text(note)}" for note in probe.doubles]
            texts.append("\n\n".join([f"**Probe {probe.folder}**", table, *doubles, *matrices]))
        if probe.grid:
            grid = render_grid(probe.grid_table(), "markdown")
            texts.append(f"**Grid {probe.folder}**\n\n{grid}")
    return texts


def _pairs_text(pairs: ChoicePairs) -> str:
    title = (
        f"First choices of {pairs.policy} on {pairs.world.task}, K = {pairs.n_action_steps}: as drawn "
        f"(rows), {pairs.world.label} (columns)"
    )
    indices = range(len(pairs.names))
    counts = [[str(pairs.counts.get((row, column), 0)) for column in indices] for row in indices]
    rows = [[name, *own] for name, own in zip(pairs.names, counts, strict=True)]
    table = markdown_table(("drawn ↓ other →", *pairs.names), rows, [False, *(True for _ in indices)])
    return f"{title}\n\n{table}"
