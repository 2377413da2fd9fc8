"""`mikasa-vla init`: write a configuration of an evaluation to start from."""

import argparse
from pathlib import Path

from vla_eval.cli.shared.output import hint_next
from vla_eval.config.files import check_recorded_name
from vla_eval.errors import MAX_SHOWN, RecipeError

DESCRIPTION = """Write FILE, a configuration of an evaluation with comments, and print the next command.

A file that is there is not overwritten. `docs/evaluation.md` has the table of all keys."""
STARTER = """\
# One evaluation. Each key is explained in docs/evaluation.md; a mistyped one is refused.
name: {name}  # of the run folder, runs/{name}-FINGERPRINT
tasks: [RememberColor3-v0]  # `mikasa-vla list tasks`
policies:
  - random  # put your own here, in one of these forms:
  # - mine=path/to/pretrained_model
  # - mine=hub:OWNER/NAME@REVISION
  # - mine=runs/act-0,runs/act-1,runs/act-2  # one row of three trainings
  # - mine: {{RememberColor3-v0: runs/act3, RememberColor9-v0: runs/act9}}  # one checkpoint per task
  # - ws://127.0.0.1:8000  # of `mikasa-vla serve`
  - cue_blind  # chance: a perfect arm that does not know the cue
  - oracle  # ceiling: a perfect arm that knows it
n_action_steps: [1, 4, 8]  # actions executed per inference; each is a row of its own
episodes: 100  # per task, policy and number of actions
seed_start: 1  # demonstrations have seeds from 1000 on
# runs: 3  # independent runs over the same seeds
# protocol: leaderboard_mikasa  # what is not set above; its mean is below the table
# env: {{delay_steps: 20}}  # arguments of the tasks, `mikasa-vla show RememberColor3-v0`
# stop_at_success: true  # faster; success at the end is then not known
# workers: 2  # changes no result
# capture: {{video: failures}}
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = DESCRIPTION
    parser.add_argument(
        "file", nargs="?", type=Path, default=Path("eval.yaml"), metavar="FILE", help="(eval.yaml)"
    )


def run(args: argparse.Namespace) -> int:
    """Write the file."""
    file: Path = args.file
    if file.suffix not in (".yaml", ".yml") or not file.stem:
        raise RecipeError(f"{file!s:.{MAX_SHOWN}}: expected a name that ends in .yaml, such as eval.yaml.")
    check_recorded_name(file.stem, kind="configs")
    try:
        with file.open("x", encoding="utf-8") as stream:
            stream.write(STARTER.format(name=file.stem))
    except FileExistsError as exc:
        raise RecipeError(f"{file}: is there already, and is not overwritten. Name another file.") from exc
    except FileNotFoundError as exc:
        raise RecipeError(f"{file}: there is no folder '{file.parent}'. Make it first.") from exc
    print(file)
    hint_next("eval", file, "--dry-run")
    return 0
