"""`mikasa-vla probe`: what a policy remembers, for how long, and whether it acts on it."""

import argparse
import math
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_eval.cli.shared.arguments import (
    EXIT_EPISODE_ERRORS,
    MANY,
    NUMBERS,
    add_flags,
    env_paths,
    read_config,
    set_flags,
)
from vla_eval.cli.shared.cluster import backend_of
from vla_eval.cli.shared.output import print_in
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import apply_overrides
from vla_eval.errors import RecipeError, unknown_name
from vla_eval.storage.shard import shard_folder
from vla_eval.workers.needed_files import Needed, shared_folder

if TYPE_CHECKING:
    from vla_eval.probe.grid import GridSettings
    from vla_eval.probe.interventions import Probe
    from vla_eval.probe.worlds import ProbeSettings, World

DESCRIPTION = """Run each task as it is and with one thing changed, on the same seeds, and compare.

swap: another cue in the same scene. A policy that uses the cue changes its choice with it.
order: the same items in another order (Seq, Chain). shuffle: as order, with the right answer as before.
blank: the cue phase passes without a cue. freeze: the policy sees the cue's first frame throughout.
mask: part of the image is hidden. late: nothing is shown before the cue. cue, delay: other lengths of the
phase. delay_swap: a swap after each delay. distractor: another item is seen in the delay. interference: the
arm is moved in the delay. reset: the policy is reset in mid-episode. instruction: other sentences.
appearance: light, camera, colours.
transplant: the memory of the swapped world is put in. carry_over: that of the episode before. memory_noise,
hold_memory, stale_memory, erase_memory: the memory has noise, is no longer updated, is old, lacks a part.

With --grid, chunk lengths against the lengths of the phases: what of the cue falls into an inference?

CONFIG is a file, or the name of one in configs/; without it, name at least one --task and one --policy.
The controls oracle, cue_blind and body_memory are run as well. The same command resumes."""
EPISODES = 50
OUT = Path("runs/probe")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, "docs/probe.md defines each quantity."
    parser.add_argument("config", nargs="?", metavar="CONFIG", help="file, or name in configs/")
    add_flags(
        parser,
        *("--task", "--policy", "--n-action-steps", "--seed-start", "--workers", "--cluster", "--shard"),
        *("--json-progress", "--format", "--allow-environment-change"),
        episodes=f"per policy and world ({EPISODES})",
        out="(runs/probe)",
        set="change any field of the evaluations",
    )
    parser.set_defaults(out=OUT)
    for flag, (dest, kind, metavar, text) in INTERVENTIONS.items():
        many = NUMBERS if kind is int else {**MANY, "type": kind}
        parser.add_argument(flag, **many, dest=dest, metavar=metavar, help=text)
    parser.add_argument(
        "--grid",
        action="store_true",
        help="each --n-action-steps (1 2 4 8) with each --delay (0 5 20 80); with --probe cue or delay,cue: "
        "with each --cue (1 2 3 5); with --probe latency: with each --latency, in each --mode",
    )
    parser.add_argument(
        "--decode", action="store_true", help="ask by linear probes what is in the memory, and when"
    )
    parser.add_argument("--no-controls", action="store_true", help="run only the policies that are named")


INTERVENTIONS: dict[str, tuple[str, Callable[[str], Any], str, str]] = {
    "--probe": (
        *("probes", lambda text: tuple(text.split(",")), "P"),
        "what to change, by spaces or commas (swap,blank,delay,reset)",
    ),
    "--swap": ("swaps", int, "K", "which other cues (1)"),
    "--delay": ("delays", int, "L", "steps (0 5 10 20 40 80 160 320)"),
    "--cue": ("cues", int, "L", "steps of the cue (1 2 3)"),
    "--mask": ("masks", str, "M", "what is hidden (cue elsewhere later)"),
    "--late": ("lates", int, "L", "steps before the cue (5 20)"),
    "--appearance": ("appearances", str, "A", "what looks different (light camera table hue)"),
    "--distract": ("distractors", int, "L", "steps (3)"),
    "--instruction": ("instructions", str, "SET", "prompt sets (paraphrased other_task no_content)"),
    "--reset-at": (
        *("reset_steps", int, "S"),
        "control steps (the end of the cue, the beginning of the response)",
    ),
    "--noise": ("noises", float, "D", "of a memory: standard deviations (0.5 1 2 4)"),
    "--hold-at": ("hold_steps", int, "S", "control steps from which a memory is held (as --reset-at)"),
    "--age": ("ages", int, "L", "of a stale memory: control steps (5 10 20)"),
    "--erase": ("erased", str, "PART", "of a memory (each)"),
    "--latency": ("latencies", int, "L", "of a grid: control steps of an inference (0 1 2 4 8)"),
    "--mode": ("modes", str, "M", "of a grid of latencies: chunking.mode (receding_horizon wait)"),
    "--first-inference": (
        *("first_inferences", int, "S"),
        "of a grid: control steps of the first inference (all below K if K does not divide the phases)",
    ),
}
"""Flag -> name, type and metavar of its value, and its help."""
LEAST = {
    **{"swaps": 1, "delays": 0, "cues": 1, "lates": 1, "distractors": 1, "reset_steps": 1},
    **{"hold_steps": 0, "ages": 1, "noises": 0.0, "first_inferences": 0, "latencies": 0},
}
"""Least number of the flags that take numbers."""
OF_GRIDS_ALONE = ("latencies", "modes", "first_inferences")
OF_GRIDS = ("probes", "delays", "cues", *OF_GRIDS_ALONE)


def run(args: argparse.Namespace) -> int:
    """Run the evaluations, then print the table to standard output; everything else to standard error."""
    from vla_eval.probe.interventions import plan_probe

    if args.grid:
        return _run_grid(args)
    for flag, (name, *_) in INTERVENTIONS.items():
        if name in OF_GRIDS_ALONE and getattr(args, name) is not None:
            raise RecipeError(f"{flag} is of a grid. Add --grid.")
    config, settings = _config(args), _settings(args)
    probe = plan_probe(config, settings)
    worlds: list[World] = []

    def in_turn() -> Iterator[EvalConfig]:
        for world in all_worlds(config, settings, probe, shard_folder(args.out, args.shard), _name_of):
            worlds.append(world)
            yield world.config

    stopped = _run_all([world.config for world in probe.worlds], args, in_turn=in_turn())
    if stopped is not None:
        return stopped
    # What draws takes half a second to import, which a mistake need not wait for.
    from vla_eval.probe.page.retention_plot import write_retention
    from vla_eval.probe.probe_text import render_probe
    from vla_eval.probe.table import read_probe

    table = read_probe(worlds, args.out)
    for path in write_retention(table, args.out):
        print(f"curve: {path}", file=sys.stderr)
    print_in(args.format, render_probe(table, args.format))
    return EXIT_EPISODE_ERRORS if table.n_errors else 0


def all_worlds(
    config: EvalConfig,
    settings: "ProbeSettings",
    probe: "Probe",
    out: Path,
    name_of: Callable[[str], str],
) -> Iterator["World"]:
    """Yield the worlds of a probe, each once the others before it were run; say what makes no sense.

    Arguments as for `plan_later`.
    """
    from vla_eval.probe.decoding import kept_nothing
    from vla_eval.probe.interventions import plan_later

    _say_left_out(probe)
    yield from probe.worlds
    later = plan_later(config, settings, probe, out, name_of)
    _say_left_out(later)
    for line in kept_nothing(probe.worlds, out) if settings.decodes else ():
        print(line, file=sys.stderr)
    yield from later.worlds


def _say_left_out(probe: "Probe") -> None:
    for line in probe.left_out:
        print(f"left out: {line}", file=sys.stderr)


def _name_of(policy: str) -> str:
    from vla_eval.policies.entries import load_policy_entry

    return load_policy_entry(policy).name


def _settings(args: argparse.Namespace) -> "ProbeSettings":
    words = None if args.probes is None else [word for words in args.probes for word in words]
    return probe_settings({**vars(args), "probes": words}, controls=not args.no_controls)


def probe_settings(chosen: Mapping[str, Any], *, controls: bool) -> "ProbeSettings":
    """Return what a probe changes, from the values of its flags by name; None: the default."""
    from vla_eval.probe.interventions import INTERVENTIONS
    from vla_eval.probe.worlds import APPEARANCES, MASKS, ProbeSettings

    numbers = {name: chosen.get(name) for name in LEAST if name not in OF_GRIDS_ALONE}
    if chosen.get("decode") and chosen.get("probes") is None:
        chosen = {**chosen, "probes": ()}  # the world as drawn is enough
    settings: dict[str, Any] = {  # Any: tuples of words or numbers
        name: _numbers(values, name) for name, values in numbers.items()
    }
    for name in ("instructions", "erased"):
        if chosen.get(name) is not None:
            settings[name] = tuple(dict.fromkeys(chosen[name]))
    for name, known, kind in (
        ("probes", INTERVENTIONS, "probe"),
        ("masks", MASKS, "mask"),
        ("appearances", APPEARANCES, "appearance"),
    ):
        settings[name] = _names(chosen.get(name), known, kind=kind, flag=f"--{kind}")
    given = {name: value for name, value in settings.items() if value is not None}
    return ProbeSettings(**given, decodes=bool(chosen.get("decode")), controls=controls)


def _grid_settings(args: argparse.Namespace) -> "GridSettings":
    from vla_eval.chunking import EXECUTIONS
    from vla_eval.probe.grid import AXES, GridSettings

    words = [word for words in args.probes or () for word in words]
    for word in words:
        if word not in AXES:
            raise RecipeError(f"--grid: --probe {word}: expected {' or '.join(AXES)}. Run it without --grid.")
    others = [
        flag
        for flag, (name, *_) in INTERVENTIONS.items()
        if name not in OF_GRIDS and getattr(args, name) is not None
    ]
    if others:
        raise RecipeError(f"--grid has no {', '.join(others)}. Run it without --grid.")
    numbers = ("delays", "cues", "latencies", "first_inferences")
    given = {name: _numbers(getattr(args, name), name) for name in numbers}
    chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if words:
        chosen["axes"] = tuple(dict.fromkeys(words))
    if args.modes is not None:
        chosen["modes"] = _names(args.modes, EXECUTIONS, kind="chunking mode", flag="--mode")
    return GridSettings(**chosen, controls=not args.no_controls)


def _names(
    words: list[str] | None, known: Collection[str], *, kind: str, flag: str
) -> tuple[str, ...] | None:
    for word in words or ():
        if word not in known:
            raise unknown_name(kind, word, known, where=flag)
    return None if words is None else tuple(dict.fromkeys(words))


def _numbers(values: list[float] | None, name: str) -> tuple[float, ...] | None:
    if values is None:
        return None
    flag = next(flag for flag, (dest, *_) in INTERVENTIONS.items() if dest == name)
    for value in values:
        if not LEAST[name] <= value < math.inf:
            kind = "whole number" if isinstance(LEAST[name], int) else "number"
            raise RecipeError(f"{flag} {value}: expected a {kind} ≥ {LEAST[name]:g}.")
    return tuple(dict.fromkeys(values))


def _run_grid(args: argparse.Namespace) -> int:
    from vla_eval.probe.grid import plan_grid
    from vla_eval.probe.grid_table import read_grid
    from vla_eval.probe.grid_text import render_grid
    from vla_eval.probe.page.heat_maps import write_heat_maps

    config, settings = _config(args), _grid_settings(args)
    # Only these ask for it: policies are read, and servers asked, once more.
    chunk_size = _shortest_chunk(config) if "latency" in settings.axes else None
    grid = plan_grid(config, settings, chunk_size=chunk_size)
    for task in grid.left_out:
        print(f"left out: {task}", file=sys.stderr)
    print(f"{len(grid.worlds)} run folders, {grid.n_episodes} episodes", file=sys.stderr)
    stopped = _run_all([world.config for world in grid.worlds], args)
    if stopped is not None:
        return stopped
    table = read_grid(grid.worlds, args.out)
    print_in(args.format, render_grid(table, args.format))
    sys.stdout.flush()  # the table first, wherever the two go
    for path in write_heat_maps(table, args.out):
        print(f"Heat map: {path}", file=sys.stderr)
    return EXIT_EPISODE_ERRORS if table.n_errors else 0


def _shortest_chunk(config: EvalConfig) -> int | None:
    """Return how many actions the shortest chunk of the policies has; None where none is known."""
    from vla_eval.evaluation.plan_checks import chunk_sizes
    from vla_eval.policies.entries import load_policy_entries

    policies = load_policy_entries(config.policies)
    return min((size for policy in policies for size in chunk_sizes(policy)), default=None)


def _run_all(
    configs: Sequence[EvalConfig], args: argparse.Namespace, *, in_turn: Iterable[EvalConfig] | None = None
) -> int | None:
    """Run or resume each evaluation, or one shard of each; return the exit code after a shard or a signal.

    `in_turn`: those that are run, where more than `configs` become known on the way, of the same policies.
    """
    from vla_eval.cli.shared.evaluations import evaluate_each
    from vla_eval.cli.shared.output import print_shard

    out = shard_folder(args.out, args.shard)
    runs = ((out / config.name, config) for config in (configs if in_turn is None else in_turn))
    with backend_of(args, needs=lambda: _needed(configs, out)) as backend:
        done = evaluate_each(runs, args, backend=backend)
    if done.stopped is not None:
        return done.stopped
    if args.shard is None:
        return None
    print_shard(out, args.out, args.shard)
    return EXIT_EPISODE_ERRORS if done.n_errors else 0


def _needed(configs: Sequence[EvalConfig], out: Path) -> tuple[Needed, ...]:
    from vla_eval.evaluation.needed_files import needed_files
    from vla_eval.policies.entries import load_policy_entries

    policies = dict.fromkeys(policy for config in configs for policy in config.policies)
    written = any(config.capture.writes_files for config in configs)
    return (*needed_files(load_policy_entries(tuple(policies))), *([shared_folder(out)] if written else []))


def _config(args: argparse.Namespace) -> EvalConfig:
    def edit(data: dict[str, Any]) -> None:  # Any: plain data of YAML
        set_flags(data, args, ("tasks", "policies", "n_action_steps", "episodes", "seed_start", "workers"))
        apply_overrides(data, args.overrides, cls=EvalConfig, free=env_paths(args.overrides))

    return read_config(
        EvalConfig,
        edit,
        folder="configs",
        name=args.config,
        start={"name": "probe", "episodes": EPISODES},
        asks="a configuration, or at least one --task and one --policy",
        needed={"tasks": "--task", "policies": "--policy"},
        example="probe --task RememberColor3-v0 --policy memory_color3",
    )
