"""`mikasa-vla dataset …`: convert, mix, check, describe and share demonstrations."""

import argparse
import functools
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from vla_eval.cli.shared.arguments import add_flags, seeds_argument, task_argument
from vla_eval.control_modes import MOTORS
from vla_eval.errors import DatasetError, RecipeError

if TYPE_CHECKING:
    from vla_eval.data.facts import ImportFacts
    from vla_eval.data.foreign.changes import Changes

MAX_SENTENCES = 5  # that `check` shows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions and their arguments."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", title="actions", required=True)
    action = functools.partial(actions.add_parser, allow_abbrev=False)

    convert = action("convert", help="to or from the paper's layout, or to another control mode")
    convert.add_argument("source", metavar="SRC", type=Path, help="folder of one task")
    goal = convert.add_mutually_exclusive_group(required=True)
    goal.add_argument("--to", choices=("npz", "lerobot"), help="the layout to write")
    goal.add_argument(
        "--control-mode",
        metavar="MODE",
        help="replay a recording, and write what the arm did in this control mode (env.control_mode)",
    )
    convert.add_argument("--out", metavar="DIR", type=Path, required=True, help="a new folder")
    convert.add_argument(
        "--task", type=task_argument, metavar="T", help="task id, for sources without an instruction"
    )
    convert.add_argument("--state", choices=("eef", "joints"), help="what observation.state is (eef)")
    convert.add_argument(
        "--image-size",
        metavar="PX",
        type=int,
        help="scale images to this size, or keep those of this size (128)",
    )
    convert.add_argument(
        "--gripper",
        metavar=("CLOSED", "OPEN"),
        nargs=2,
        type=float,
        help="the source's commands that close and open the gripper (-1 1)",
    )
    convert.add_argument(
        "--resample", action="store_true", help="compute frames at 20 per second from another rate"
    )
    convert.add_argument(
        "--clip-actions", action="store_true", help="store actions as the environment would execute them"
    )
    add_flags(convert, "--workers")
    convert.set_defaults(workers="auto")

    mix = action("mix", help="make one dataset of several, for a policy that learns several tasks")
    mix.add_argument("datasets", metavar="DIR", type=Path, nargs="+", help="complete datasets, one per task")
    mix.add_argument("--out", metavar="DIR", type=Path, required=True, help="a new folder")

    check = action(
        "check",
        help="say all that differs from what is expected (exit code 1 if something has to be changed)",
    )
    check.add_argument("dataset", metavar="DIR", type=Path, help="any dataset, also one made elsewhere")

    adopt = action("adopt", help="use a dataset that lerobot-edit-dataset has edited")
    adopt.add_argument("dataset", metavar="DIR", type=Path, help="a dataset with this project's fields")
    adopt.add_argument("--task", type=task_argument, metavar="T", help="task id of its demonstrations")

    leak = action(
        "check-leak",
        help="whether demonstrations begin as the evaluation's episodes do (exit code 1 if any does)",
    )
    leak.add_argument("dataset", metavar="DIR", type=Path, help="a dataset, or what `convert` reads")
    leak.add_argument("--task", type=task_argument, metavar="T", help="task id, for datasets that name none")
    leak.add_argument("--seeds", metavar="A-B", type=seeds_argument, help="seeds of the evaluation (1-100)")

    card = action("card", help="write README.md and a contact sheet")
    card.add_argument("dataset", metavar="DIR", type=Path, help="a complete dataset")
    card.add_argument("--license", metavar="ID", help="licence as the Hub names it (recordings: mit)")

    push = action("push", help="upload a complete dataset to the Hub")
    push.add_argument("dataset", metavar="DIR", type=Path, help="a complete dataset")
    push.add_argument("repo_id", metavar="REPO_ID", help="USER/NAME on the Hub")
    push.add_argument("--private", action="store_true", help="make the repository a private one")

    pull = action("pull", help="download a dataset from the Hub")
    pull.add_argument("repo_id", metavar="REPO_ID", help="USER/NAME on the Hub")
    pull.add_argument("out", metavar="DIR", type=Path, help="a new folder")
    pull.add_argument("--revision", metavar="REV", help="branch, tag or commit (default: the newest)")


def run(args: argparse.Namespace) -> int:
    """Do the action; what it reads is looked for first, before torch is loaded."""
    from vla_eval.data.info_file import require_folder
    from vla_eval.tasks.catalog import task_spec

    if getattr(args, "task", None) is not None:
        task_spec(args.task)
    read = {"convert": "source", "mix": "datasets", "pull": None}.get(args.action, "dataset")
    named = [] if read is None else getattr(args, read)
    for folder in named if isinstance(named, list) else [named]:
        require_folder(folder)
    return _ACTIONS[args.action](args)


def _convert(args: argparse.Namespace) -> int:
    if args.control_mode is not None:
        return _convert_control_mode(args)
    from vla_eval.data.foreign.convert import convert_to_lerobot, convert_to_npz, find_source

    changes = _changes(args)
    source = find_source(args.source)
    if args.to == "npz":
        print(f"{args.out}: {convert_to_npz(source, args.out)} episodes in the paper's layout")
        return 0
    facts = convert_to_lerobot(source, args.out, state=args.state or "eef", changes=changes)
    print(f"{args.out}: {len(facts.episodes)} episodes, {facts.n_frames} frames, from {facts.source_layout}")
    print(f"instruction from {facts.instruction_source}; actions for {facts.control_mode}")
    _print_sentences(facts)
    if not facts.executable_by_pd_ee_delta_pose:
        print(f"A policy trained on them is evaluated with --set env.control_mode={facts.control_mode}.")
    return 0


def _changes(args: argparse.Namespace) -> "Changes":
    from vla_eval.data.foreign.changes import Changes
    from vla_eval.tasks.catalog import task_spec

    changes = Changes(
        task=None if args.task is None else task_spec(args.task),
        image_size_px=args.image_size,
        gripper=None if args.gripper is None else tuple(args.gripper),
        resample=args.resample,
        clip_actions=args.clip_actions,
    )
    flags = _asked_for(args)
    if args.to == "npz" and flags:
        raise RecipeError(f"{flags[0]}: the paper's layout is written as the source is. Remove it.")
    return changes


def _asked_for(args: argparse.Namespace) -> list[str]:
    """Return those of the flags that change data that are given."""
    names = ("--task", "--state", "--image-size", "--gripper", "--resample", "--clip-actions")
    values = {name: getattr(args, name.strip("-").replace("-", "_")) for name in names}
    return [name for name, value in values.items() if value is not None and value is not False]


def _convert_control_mode(args: argparse.Namespace) -> int:
    from vla_eval.cli.record import describe
    from vla_eval.cli.terminal.progress import RecordingProgress, stop_on_signals
    from vla_eval.control_modes import action_spec

    action_spec(args.control_mode)  # a mistyped name must not wait for the simulator's libraries
    for flag in _asked_for(args):
        raise RecipeError(f"{flag}: --control-mode keeps all else of the recording. Remove it.")
    from vla_eval.data.derived.control_conversion import convert_control_mode

    with stop_on_signals() as stop, closing(RecordingProgress(stop)) as progress:
        converted = convert_control_mode(
            args.source, args.control_mode, out=args.out, observer=progress, workers=args.workers
        )
    if converted is None:
        print("Stopped. The same command resumes.", file=sys.stderr)
        return stop.exit_code
    print(describe(converted.dataset))
    n_kept = converted.dataset.facts.n_episodes
    print(
        f"{n_kept} of {converted.n_episodes} episodes succeed in {args.control_mode} and are in it; "
        f"{converted.n_same_states} have the recorded states, bit for bit"
    )
    for sentence in converted.left_out:
        print(f"left out: {sentence}")
    return 0


def _mix(args: argparse.Namespace) -> int:
    from vla_eval.data.derived.mixing import mix_datasets

    facts = mix_datasets(args.datasets, args.out)
    for source in facts.sources:
        print(f"{source.name}: {source.n_episodes} episodes, {source.n_frames} frames")
    n_episodes = sum(source.n_episodes for source in facts.sources)
    print(f"{args.out}: {len(facts.tasks)} tasks, {n_episodes} episodes, {facts.n_frames} frames")
    for sentence in facts.shared_scenes:
        print(f"note: {sentence}")
    if not facts.was_replayed and facts.control_mode != MOTORS:
        names = ", ".join(source.name for source in facts.sources if not source.was_replayed)
        print(f"not replayed: {names}. `finetune` asks for --allow-unreplayed.")
    return 0


def _check(args: argparse.Namespace) -> int:
    from vla_eval.data.check import check

    report = check(args.dataset)
    what = report.demonstrations
    print(f"{args.dataset}: {report.kind}")
    print(f"{len(what.lengths)} episodes, {what.n_frames} frames, {what.fps:g} per second")
    for camera, (height, width) in what.image_sizes_px.items():
        print(f"{camera}: {height} × {width}")
    for sentence, n_frames in Counter(what.sentences).most_common(MAX_SENTENCES):
        print(f"sentence: {sentence!r} ({n_frames} frames)")
    for said in report.said:
        print(f"{said.answer}: {said.sentence}")
    if not report.said:
        print("as expected")
    if report.is_refused:
        n_refused = sum(said.answer == "refused" for said in report.said)
        raise DatasetError(f"{args.dataset}: {n_refused} of these have to be changed before it can be used.")
    if report.next_step:
        print(f"next: {report.next_step}")
    return 0


def _adopt(args: argparse.Namespace) -> int:
    from vla_eval.data.adopt import adopt
    from vla_eval.tasks.catalog import task_spec

    facts = adopt(args.dataset, task=None if args.task is None else task_spec(args.task))
    print(
        f"{args.dataset}: {len(facts.episodes)} episodes, {facts.n_frames} frames, for {facts.control_mode}"
    )
    _print_sentences(facts)
    if facts.control_mode != MOTORS:
        print("Seeds and phases are lost: it cannot be replayed. `finetune` asks for --allow-unreplayed.")
    return 0


def _print_sentences(facts: "ImportFacts") -> None:
    for label, sentences in (("converted", facts.converted), ("kept", facts.kept)):
        for sentence in sentences:
            print(f"{label}: {sentence}")
    for label, names in (("the source has no", facts.absent), ("left out", facts.left_out)):
        if names:
            print(f"{label}: {', '.join(names)}")


def _check_leak(args: argparse.Namespace) -> int:
    from vla_eval.config.dataset import EVALUATION_SEEDS
    from vla_eval.data.sharing.initial_states import read_initial_states
    from vla_eval.data.sharing.leak import check_leak
    from vla_eval.results.printed_table import markdown_table

    dataset = read_initial_states(args.dataset)
    task = args.task or dataset.task
    if task is None:
        raise DatasetError(f"{args.dataset}: names no task. Add --task (`mikasa-vla list tasks`).")
    report = check_leak(dataset, task=task, seeds=args.seeds or EVALUATION_SEEDS)
    what = {"state": "the arm's initial state", "frames": "first frames"}[report.evidence]
    compared = (
        f"{report.n_episodes} episodes with seeds {report.seeds[0]} to {report.seeds[-1]} of {report.task}, "
        f"by {what}"
    )
    if not report.shared:
        print(f"No episode begins as the evaluation's do: compared {compared}.")
        return 0
    rows = [
        [one.episode, "—" if one.dataset_seed is None else str(one.dataset_seed), str(one.evaluation_seed)]
        for one in report.shared
    ]
    print(markdown_table(["demonstration", "its own seed", "evaluation seed"], rows, [False, True, True]))
    n_shared = len({one.episode for one in report.shared})
    raise DatasetError(
        f"{args.dataset}: {n_shared} of {report.n_episodes} demonstrations begin as an evaluation's episode "
        f"does (compared {compared}). A policy trained on them would be tested on what it was shown: leave "
        "these episodes out, or evaluate on other seeds (--seed-start)."
    )


def _card(args: argparse.Namespace) -> int:
    from vla_eval.data.sharing.card import CARD_FILE, SHEET_FILE, write_card

    write_card(args.dataset, license_id=args.license)
    print(f"{args.dataset / CARD_FILE}\n{args.dataset / SHEET_FILE}")
    return 0


def _push(args: argparse.Namespace) -> int:
    from vla_eval.data.sharing.hub import push_dataset

    print(push_dataset(args.dataset, args.repo_id, private=args.private))
    return 0


def _pull(args: argparse.Namespace) -> int:
    from vla_eval.data.sharing.hub import pull_dataset

    pulled = pull_dataset(args.repo_id, args.out, revision=args.revision)
    print(f"{args.out}: commit {pulled.commit}, complete and checked")
    return 0


_ACTIONS: dict[str, Callable[[argparse.Namespace], int]] = {
    "convert": _convert,
    "mix": _mix,
    "check": _check,
    "adopt": _adopt,
    "check-leak": _check_leak,
    "card": _card,
    "push": _push,
    "pull": _pull,
}
