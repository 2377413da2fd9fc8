"""Suggestions for flags and words that are often typed for others. Knows nothing of what verbs do."""

import argparse
import difflib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence

from vla_eval.errors import NOT_SET, did_you_mean

MEANT: Mapping[str, Sequence[str]] = {
    "--seed": ("--seed-start", "--seeds", "--run-seed"),
    "--seeds": ("--seed-start", "--seed", "--run-seed"),
    "--seed-start": ("--seeds", "--seed", "--run-seed"),
    "--run-seed": ("--seed-start", "--seed"),
    "--num-envs": ("--workers",),
    "--type": (),
    "--path": ("--base-checkpoint", "--policy"),
    "--repo-id": ("--dataset", "--policy"),
    "--epochs": ("--steps",),
    "--max-steps": ("--steps", "--set"),
    "--save-video": ("--capture-video",),
    "--instruction": ("--set",),
    "--job-name": ("--out",),
    "--first-seed": ("--seed-start", "--seed"),
    "--n-episodes": ("--episodes", "--episode"),
    "--num-episodes": ("--episodes", "--episode"),
    "--eval-episodes": ("--episodes",),
    "--tasks": ("--task",),
    "--env": ("--task",),
    "--env-id": ("--task",),
    "--policies": ("--policy",),
    "--model": ("--policy",),
    **dict.fromkeys(("--checkpoint", "--ckpt", "--weights"), ("--base-checkpoint", "--policy")),
    **dict.fromkeys(("--csv", "--latex", "--json", "--markdown"), ("--format",)),
    "--policy-path": ("--policy",),
    "--num-workers": ("--workers",),
    "--jobs": ("--workers",),
    "--chunk-size": ("--n-action-steps",),
    "--horizon": ("--n-action-steps",),
    "--action-steps": ("--n-action-steps",),
    "-K": ("--n-action-steps",),
    "-k": ("--n-action-steps",),
    "--output": ("--out",),
    "--output-dir": ("--out",),
    "-o": ("--out",),
    "--dir": ("--out",),
    "--video": ("--capture-video",),
    "--record-videos": ("--capture-video",),
    "--videos": ("--capture-video",),
    "--rerun": ("--capture-rrd",),
    "--batch": ("--batch-size", "--max-batch"),
    "--batch-size": ("--max-batch", "--workers"),
    **dict.fromkeys(("--lr", "--learning-rate", "--save-freq", "--log-freq", "--wandb"), ("--set",)),
    "--override": ("--set",),
    "--config": ("--set",),
    "--resume": (),
    "--by": (),
    "--device": (),
    "--gpu": ("--device",),
    "--page": ("--html",),
}
"""Flag that a verb has not -> flags that may be meant; the first that the verb has is suggested."""
TOLD: Mapping[str, str] = {
    "--resume": "The same command again resumes.",
    "--device": "A policy's recipe says the device: `args: {device: cuda}` (auto by default); for the "
    "simulator: --set render.backend=gpu.",
    "--gpu": "A policy's recipe says the device: `args: {device: cuda}` (auto by default).",
    "--by": "The table has a row for each K. Differences between K or policies: mikasa-vla compare RUN --by "
    "n_action_steps (or policy).",
    "--config": "The configuration comes without a flag: mikasa-vla eval configs/mine.yaml.",
    "--lr": "Learning rates are fields of the recipe.",
    "--learning-rate": "Learning rates are fields of the recipe.",
    "--save-freq": "It is a field of the recipe: --set save_every_steps=1000.",
    "--log-freq": "It is a field of the recipe: --set log_every_steps=100.",
    "--wandb": "It is a field of the recipe: --set wandb_project=NAME.",
    "--max-steps": "The length of an episode: --set env.horizon_steps=90.",
    "--instruction": "Sentences are in a file of prompts: --set prompt_set=FILE.",
}
"""Flag -> what helps where no verb's flag does, or beside it."""
WORDS: Mapping[str, str] = {
    "tex": "latex",
    "md": "markdown",
    "table": "markdown",
    "k": "n_action_steps",
    "n-action-steps": "n_action_steps",
    "policies": "policy",
    **dict.fromkeys(("envs", "environments"), "tasks"),
    **dict.fromkeys(("models", "checkpoints"), "policies"),
    **{"train": "finetune", "test": "eval", "info": "show", "help": "--help", "version": "--version"},
}
"""Word, in small letters -> choice that is meant."""
CLOSE = 0.65  # of a flag's name, without the dashes that all have


def about_flag(flag: str, known: Collection[str]) -> str:
    """Return what to say of a flag that a verb has not."""
    # `--eval.n_episodes` of other programs: as a whole, its last name, its first.
    whole = re.sub(r"[._]", "-", flag.lower()) if flag.startswith("--") else flag
    first, _, last = flag.lower().lstrip("-").replace("_", "-").rpartition(".")
    for name in dict.fromkeys((whole, f"--{last}", f"--{first}")) if first else (whole,):
        meant = next((one for one in (name, *MEANT.get(name, ())) if one in known), None)
        told = f" {TOLD[name]}" if name in TOLD and meant in (None, "--set") else ""
        if meant is not None:
            return f" Did you mean '{meant}'?{told}"
        if told:
            return told
    names = [one.lstrip("-") for one in known]
    close = difflib.get_close_matches(whole.lstrip("-"), names, n=1, cutoff=CLOSE)
    return f" Did you mean '--{close[0]}'?" if close else ""


def about_choice(value: object, choices: Iterable[object]) -> str:
    """Return a suggestion for a word that is none of the choices."""
    known = [str(one) for one in choices]
    meant = WORDS.get(str(value).lower())
    return f" Did you mean '{meant}'?" if meant in known else did_you_mean(str(value), known)


def about_empty(arguments: Sequence[str]) -> str | None:
    """Return what is wrong if an argument is empty, as that of a shell variable that is not set."""
    for index, text in enumerate(arguments):
        flag, equals, value = text.partition("=")
        is_flag = flag.startswith("--")
        if (text == "" or (is_flag and equals and not value)) and flag != "--set":
            before = [one for one in arguments[:index] if one.startswith("--")]
            name = flag if is_flag else before[-1] if before else "an argument"
            return f"{name}: expected a value, found empty text. {NOT_SET}"
    return None


class Several(argparse.Action):
    """Takes all values of a flag that is given once: given again, it may mean more of them, or others."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        """Store the values; those of `numbers` may be several in a word."""
        if getattr(namespace, self.dest, self.default) is not self.default:
            raise argparse.ArgumentError(self, f"is given twice. Name all after one: {option_string} A B.")
        parts = values if isinstance(values, list) else [values]
        setattr(
            namespace, self.dest, [v for part in parts for v in (part if isinstance(part, list) else [part])]
        )


def numbers(text: str) -> list[int]:
    """Read one or several numbers; a comma at the end is that of `1, 4, 8`."""
    parts = text.removesuffix(",").split(",")
    try:
        return [int(part) for part in parts]
    except ValueError as exc:
        raise argparse.ArgumentTypeError(f"expected whole numbers such as 1 4 8, found '{text}'") from exc
