"""`mikasa-vla completion`: print a shell's completion. Not by shtab, which completes no names by verb."""

import argparse
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

DESCRIPTION = """Print what a shell needs to complete verbs, flags, and names of tasks, policies and configs.

  bash: mikasa-vla completion bash > ~/.local/share/bash-completion/completions/mikasa-vla
  zsh:  mikasa-vla completion zsh > DIR/_mikasa-vla, with DIR in fpath
  fish: mikasa-vla completion fish > ~/.config/fish/completions/mikasa-vla.fish

The names are those of this version and of the working directory, at the time of the call."""
ZSH = "#compdef mikasa-vla\nautoload -U +X bashcompinit && bashcompinit\n"
NAMES_OF_FLAG = {"--task": "tasks", "--policy": "policies"}
NAMES_OF_VERB = {"eval": "configs", "show": "tasks", "check": "policies"}


class Words(NamedTuple):
    """What can follow."""

    flags: Mapping[str, Sequence[str]]  # verb -> its long flags
    values: Mapping[str, Sequence[str]]  # flag -> the names that may follow it
    names: Mapping[str, Sequence[str]]  # verb -> the names that may follow it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = DESCRIPTION
    parser.add_argument("shell", choices=tuple(_SHELLS), help="the shell")


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    print(_SHELLS[args.shell](_words()))
    return 0


def _words() -> Words:
    from vla_eval.cli.main import VERBS, build_parser, flags_of
    from vla_eval.config.files import list_recipes
    from vla_eval.tasks.catalog import TASKS, installed_tasks

    known = {
        "tasks": [*TASKS, *_plain(installed_tasks())],
        "policies": _plain(list_recipes("policies")),
        "configs": _plain(list_recipes("configs")),
    }
    flags = {verb: flags_of(build_parser((verb,))) for verb in VERBS}
    return Words(
        flags={verb: [flag for flag in found if flag != "--version"] for verb, found in flags.items()},
        values={flag: known[kind] for flag, kind in NAMES_OF_FLAG.items()},
        names={verb: known[kind] for verb, kind in NAMES_OF_VERB.items()},
    )


def _plain(names: Iterable[str]) -> list[str]:
    """Return the names that no shell would run: they are names of files in the working directory, too."""
    return [name for name in names if re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", name)]


def _bash(words: Words) -> str:
    values = "\n".join(
        f'    {flag}) COMPREPLY=($(compgen -W "{" ".join(names)}" -f -- "$current")); return ;;'
        for flag, names in words.values.items()
    )
    verbs = "\n".join(
        f'    {verb}) words="{" ".join((*flags, *words.names.get(verb, ())))}" ;;'
        for verb, flags in words.flags.items()
    )
    return f"""_mikasa_vla() {{
  local current="${{COMP_WORDS[COMP_CWORD]}}" flag="" words="" i
  if [ "$COMP_CWORD" -eq 1 ]; then
    COMPREPLY=($(compgen -W "{" ".join(words.flags)}" -- "$current"))
    return
  fi
  for ((i = COMP_CWORD - 1; i > 1; i--)); do
    case "${{COMP_WORDS[i]}}" in -*) flag="${{COMP_WORDS[i]}}"; break ;; esac
  done
  case "$current" in -*) flag="" ;; esac
  case "$flag" in
{values}
  esac
  case "${{COMP_WORDS[1]}}" in
{verbs}
  esac
  COMPREPLY=($(compgen -W "$words" -f -- "$current"))
}}
complete -F _mikasa_vla mikasa-vla"""


def _fish(words: Words) -> str:
    lines = [f"complete -c mikasa-vla -n __fish_use_subcommand -f -a '{' '.join(words.flags)}'"]
    for verb, flags in words.flags.items():
        condition = f"-n '__fish_seen_subcommand_from {verb}'"
        for flag in flags:
            names = words.values.get(flag)
            value = f" -x -a '{' '.join(names)}'" if names else ""
            lines.append(f"complete -c mikasa-vla {condition} -l {flag.removeprefix('--')}{value}")
        if verb in words.names:
            lines.append(f"complete -c mikasa-vla {condition} -a '{' '.join(words.names[verb])}'")
    return "\n".join(lines)


_SHELLS: Mapping[str, Callable[[Words], str]] = {
    "bash": _bash,
    "zsh": lambda words: f"{ZSH}{_bash(words)}",
    "fish": _fish,
}
