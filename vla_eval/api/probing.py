"""`vla_eval.run_probe`: `mikasa-vla probe` from Python, also for a policy that is a Python object."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # policies are whatever the user gives; plain data

from markupsafe import Markup

from vla_eval.api.configured import listed
from vla_eval.api.evaluating import entries_of, eval_config, run_or_resume
from vla_eval.api.run import Text, in_colors, notebook_html
from vla_eval.cli.probe import EPISODES, INTERVENTIONS, OUT, all_worlds, probe_settings
from vla_eval.cli.shared.evaluations import in_turn
from vla_eval.config.evaluation import EvalConfig
from vla_eval.policies.entries import PolicyEntry, load_policy_entry
from vla_eval.probe.interventions import plan_probe
from vla_eval.probe.page.retention_plot import write_retention
from vla_eval.probe.page.sections import retention_plots
from vla_eval.probe.probe_text import render_probe
from vla_eval.probe.table import ProbeTable, read_probe
from vla_eval.probe.worlds import World
from vla_eval.results.formats import Format
from vla_eval.strict.calls import public


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeResult:
    """What a probe found.

    Attributes:
        out: the folder of its run folders.
        found: the rows, one per task, policy and change, and the retention curves.
        plots: files of the retention curves.
    """

    out: Path
    found: ProbeTable
    plots: tuple[Path, ...]

    @public
    def table(self, format: Format = "markdown") -> Text:
        """Return the table, as `mikasa-vla probe` prints it."""
        return Text(render_probe(self.found, format), format)

    def _repr_markdown_(self) -> str:
        return self.table()

    def _repr_html_(self) -> str:
        """Return table and retention curves, for notebooks."""
        plots = retention_plots(self.found)
        legend = [Markup("{} {} &emsp;").format(one.svg, one.name) for one in plots.legend if plots.charts]
        drawn = in_colors([*legend, *(chart.svg for chart in plots.charts)])
        return notebook_html(self.table("html-table"), [drawn])


@public
def run_probe(
    config: EvalConfig | str | Path | None = None,
    *,
    policy: Any = None,
    tasks: str | Sequence[str] | None = None,
    out: str | Path = OUT,
    probes: str | Sequence[str] | None = None,
    delays: Sequence[int] | None = None,
    decode: bool = False,
    controls: bool = True,
    in_process: bool = False,
    allow_environment_change: bool = False,
    **fields: Any,
) -> ProbeResult:
    """Find out what a policy remembers, and for how long, as `mikasa-vla probe` does; the same call resumes.

    Args:
        config: a configuration, its file, or the name of one in `configs/`; None: the arguments say it all.
        policy: as for `evaluate`.
        tasks: one task id or several.
        out: the folder of the run folders.
        probes: what is changed: `swap`, `blank`, `delay`, `reset`, … (docs/probe.md); None: these four.
        delays: lengths of the delay, control steps.
        decode: whether linear probes ask what is in the memory, and when; without `probes`, nothing else is
            run.
        controls: whether `oracle`, `cue_blind` and `body_memory` are run as well.
        in_process: as for `evaluate`.
        allow_environment_change: as for `evaluate`.
        **fields: further fields of `ProbeSettings` (`swaps`, `cues`, `masks`, …), and of `EvalConfig`
            (`episodes`, `workers`, `n_action_steps`, `env`, …).

    Raises:
        VlaEvalError: a mistake.
        KeyboardInterrupt: Ctrl-C; what has finished is kept.
    """
    given = {"probes": probes, "delays": delays, **fields}
    chosen = {name: listed(given.pop(name, None)) for name, *_ in INTERVENTIONS.values()}
    entries = entries_of(policy)
    start = {"name": "probe", "episodes": EPISODES}
    read = eval_config(config, entries, {"tasks": tasks, **given}, where="run_probe", start=start)
    settings = probe_settings({**chosen, "decode": decode}, controls=controls)
    probe = plan_probe(read, settings)
    objects = {one.name: one for one in entries if isinstance(one, PolicyEntry)}

    def run(folder: Path, config: EvalConfig) -> None:
        run_or_resume(
            config,
            [objects.get(name, name) for name in config.policies],
            out=folder,
            in_process=in_process,
            allow_environment_change=allow_environment_change,
            command="vla_eval.run_probe(…)",
        )

    def name_of(policy: str) -> str:
        return policy if policy in objects else load_policy_entry(policy).name

    worlds: list[World] = []

    def folders() -> Iterator[tuple[Path, EvalConfig]]:
        for world in all_worlds(read, settings, probe, Path(out), name_of):
            worlds.append(world)
            yield Path(out) / world.config.name, world.config

    in_turn(folders(), run)
    found = read_probe(worlds, Path(out))
    return ProbeResult(out=Path(out), found=found, plots=tuple(write_retention(found, Path(out))))
