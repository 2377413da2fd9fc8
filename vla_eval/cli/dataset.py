"""`mikasa-vla dataset …`: convert demonstrations, describe them, share them."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any


def add_parser(subparsers: "argparse._SubParsersAction[Any]") -> None:
    """Declare the actions and their arguments."""
    parser = subparsers.add_parser("dataset", help="convert, describe or share datasets", allow_abbrev=False)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", title="actions", required=True)

    convert = actions.add_parser("convert", help="to or from the paper's layout", allow_abbrev=False)
    convert.add_argument("source", metavar="SRC", type=Path, help="folder of one task")
    convert.add_argument("--to", choices=("npz", "lerobot"), required=True, help="the layout to write")
    convert.add_argument("--out", metavar="DIR", type=Path, required=True, help="a new folder")
    convert.add_argument("--task", metavar="T", help="task id, for sources without an instruction")
    convert.add_argument(
        "--state", choices=("eef", "joints"), default="eef", help="what observation.state is (%(default)s)"
    )

    card = actions.add_parser("card", help="write README.md and a contact sheet", allow_abbrev=False)
    card.add_argument("dataset", metavar="DIR", type=Path, help="a complete dataset")
    card.add_argument("--license", metavar="ID", help="licence as the Hub names it (recordings: mit)")

    push = actions.add_parser("push", help="upload a complete dataset to the Hub", allow_abbrev=False)
    push.add_argument("dataset", metavar="DIR", type=Path, help="a complete dataset")
    push.add_argument("repo_id", metavar="REPO_ID", help="USER/NAME on the Hub")
    push.add_argument("--private", action="store_true", help="make the repository a private one")

    pull = actions.add_parser("pull", help="download a dataset from the Hub", allow_abbrev=False)
    pull.add_argument("repo_id", metavar="REPO_ID", help="USER/NAME on the Hub")
    pull.add_argument("out", metavar="DIR", type=Path, help="a new folder")
    pull.add_argument("--revision", metavar="REV", help="branch, tag or commit (default: the newest)")


def run(args: argparse.Namespace) -> int:
    """Do the action."""
    return _ACTIONS[args.action](args)


def _convert(args: argparse.Namespace) -> int:
    from vla_eval.data.convert import convert_to_lerobot, convert_to_npz, find_source
    from vla_eval.tasks.catalog import task_spec

    if args.task is not None:
        task_spec(args.task)  # a mistyped name must not wait for the simulator's libraries
    source = find_source(args.source)
    if args.to == "npz":
        print(f"{args.out}: {convert_to_npz(source, args.out)} episodes in the paper's layout")
        return 0
    facts = convert_to_lerobot(source, args.out, task=args.task, state=args.state)
    print(f"{args.out}: {len(facts.episodes)} episodes, {facts.n_frames} frames, from {facts.source_layout}")
    print(f"instruction from {facts.instruction_source}; actions for {facts.control_mode}")
    for label, names in (("the source has no", facts.absent), ("left out", facts.left_out)):
        if names:
            print(f"{label}: {', '.join(names)}")
    if not facts.executable_by_pd_ee_delta_pose:
        print("The environments here use pd_ee_delta_pose: they cannot execute these actions.")
    return 0


def _card(args: argparse.Namespace) -> int:
    from vla_eval.data.card import CARD_FILE, SHEET_FILE, write_card

    write_card(args.dataset, license_id=args.license)
    print(f"{args.dataset / CARD_FILE}\n{args.dataset / SHEET_FILE}")
    return 0


def _push(args: argparse.Namespace) -> int:
    from vla_eval.data.hub import push_dataset

    print(push_dataset(args.dataset, args.repo_id, private=args.private))
    return 0


def _pull(args: argparse.Namespace) -> int:
    from vla_eval.data.hub import pull_dataset

    pulled = pull_dataset(args.repo_id, args.out, revision=args.revision)
    print(f"{args.out}: commit {pulled.commit}, complete and checked")
    return 0


_ACTIONS: dict[str, Callable[[argparse.Namespace], int]] = {
    "convert": _convert,
    "card": _card,
    "push": _push,
    "pull": _pull,
}
