"""`mikasa-vla checkpoint convert-…`: a verb for each family whose published checkpoints can be converted."""

import argparse
from pathlib import Path
from typing import Any

from vla_eval.cli.shared.arguments import add_old_flag
from vla_eval.models.families import FAMILIES
from vla_eval.models.family import Family, imported
from vla_eval.models.shared.options import Flag, flags_of


def converted_families() -> dict[str, Family]:
    """Return the families with a converter by their verbs."""
    return {f"convert-{family.name}": family for family in FAMILIES.values() if family.converter}


def add_parsers(actions: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    for verb, family in converted_families().items():
        convert = actions.add_parser(verb, help="make a LeRobot checkpoint of it", allow_abbrev=False)
        convert.add_argument("path", metavar="PATH", help="folder of the published checkpoint")
        convert.add_argument("--out", metavar="DIR", required=True, help="folder to write")
        for flag in flags_of(imported(family.convert_options)).values():
            choices = {"choices": tuple(flag.values)} if flag.values else {}
            convert.add_argument(flag.name, **choices, **flag.settings)
            if flag.former:
                add_old_flag(convert, flag.former, flag.name, nargs=flag.settings.get("nargs"))


def run(args: argparse.Namespace) -> list[str]:
    """Do it; return lines for standard output."""
    # Here and not above: `mikasa-vla --help` need not wait for torch.
    from vla_eval.checkpoints.conversion import convert

    family = converted_families()[args.action]
    options = imported(family.convert_options)
    given = {name: _value(args, flag) for name, flag in flags_of(options).items()}
    named = {name: value for name, value in given.items() if value is not None}
    return [str(convert(family.type, Path(args.path), Path(args.out), options(**named)))]


def _value(args: argparse.Namespace, flag: Flag) -> Any:
    value = getattr(args, flag.name.removeprefix("--").replace("-", "_"))
    if flag.values and value is not None:
        return flag.values[value]
    return tuple(value) if isinstance(value, list) else value
