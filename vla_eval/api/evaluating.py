"""`vla_eval.evaluate`: `mikasa-vla eval` from Python, also for a policy that is a Python object."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any  # policies are whatever the user gives; plain data

from vla_eval.api.configured import configured, listed
from vla_eval.api.run import Run, load_run
from vla_eval.cli.terminal.progress import evaluate_with_progress, stop_on_signals
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import digest_of
from vla_eval.config.protocol import fill_from_protocol
from vla_eval.errors import RecipeError
from vla_eval.evaluation.resolve import FINGERPRINT_DIGITS, ResolvedEvaluation
from vla_eval.policies.entries import PolicyEntry, load_policy_entry
from vla_eval.policies.given import given_entry
from vla_eval.storage.starting import RUNS_FOLDER
from vla_eval.strict.calls import public
from vla_eval.workers.in_process import IN_PROCESS
from vla_eval.workers.local import LOCAL


@public
def evaluate(
    config: EvalConfig | str | Path | None = None,
    *,
    policy: Any = None,
    tasks: str | Sequence[str] | None = None,
    n_action_steps: int | Sequence[int] | None = None,
    out: str | Path | None = None,
    in_process: bool = False,
    allow_environment_change: bool = False,
    **fields: Any,
) -> Run:
    """Run or resume an evaluation, as `mikasa-vla eval` does, and return its results.

    The same call again, in the same folder, runs only the episodes that have no result yet. Policies run in
    worker processes, on copies of what is given: what an instance remembers there is not seen here. Scripts
    need no `if __name__ == "__main__"`.

    Args:
        config: a configuration, its file, or the name of one in `configs/`; None: the arguments say it all.
        policy: one policy or a list of them: a name as for `--policy`, an instance, a class, or a function
            that makes one from a `PolicyContext` or from nothing. A mapping gives them names for the table;
            in it, `{"mine": {task: folder}}` is one policy with a checkpoint for each task.
        tasks: one task id or several.
        n_action_steps: one number or several: actions executed per inference (K).
        out: the run folder; None: one in `runs/`, for each configuration and each version of the policies.
        in_process: run the episodes one after another in this process: for a debugger, or to see what a
            policy prints. No time limit then applies.
        allow_environment_change: resume although package versions or the machine have changed.
        **fields: further fields of `EvalConfig`: `episodes`, `seed_start`, `runs`, `workers`, `env`, …

    Raises:
        VlaEvalError: a mistake that every episode would repeat; see `vla_eval.evaluation.evaluate`.
        KeyboardInterrupt: Ctrl-C; what has finished is kept, and the same call resumes.
    """
    entries = entries_of(policy)
    read = eval_config(
        config, entries, {"tasks": tasks, "n_action_steps": n_action_steps, **fields}, where="evaluate"
    )
    return run_or_resume(
        read,
        entries or read.policies,
        out=Path(out) if out else None,
        in_process=in_process,
        allow_environment_change=allow_environment_change,
        command="vla_eval.evaluate(…)",
    )


def run_or_resume(
    config: EvalConfig,
    entries: Sequence[str | PolicyEntry],
    *,
    out: Path | None,
    in_process: bool,
    allow_environment_change: bool,
    command: str,
) -> Run:
    """Run or resume one evaluation; arguments as for `evaluate`, with the policies as entries or names."""
    policies = [one if isinstance(one, PolicyEntry) else load_policy_entry(one) for one in entries]
    backend = IN_PROCESS if in_process else LOCAL
    resolved = ResolvedEvaluation.of(config, policies, backend=backend, out=out)
    objects = {one.name: one.recipes[0].sha256 for one in entries if isinstance(one, PolicyEntry)}
    if objects and out is None:  # another version of the class is another run
        digest = digest_of([resolved.fingerprint, objects])[:FINGERPRINT_DIGITS]
        resolved = replace(resolved, named_out=RUNS_FOLDER / f"{config.name}-{digest}")
    with stop_on_signals() as stop:
        summary = evaluate_with_progress(
            resolved,
            command=command,
            stop=stop,
            allow_environment_change=allow_environment_change,
            json_progress=None,
        )
    if summary.was_stopped:
        n_done = summary.n_episodes - summary.n_open
        raise KeyboardInterrupt(
            f"stopped with {n_done} of {summary.n_episodes} episodes in {summary.out}; the same call resumes"
        )
    return load_run(summary.out)


def eval_config(
    config: EvalConfig | str | Path | None,
    entries: Sequence[str | PolicyEntry],
    given: Mapping[str, Any],
    *,
    where: str,
    start: Mapping[str, Any] = MappingProxyType({}),
) -> EvalConfig:
    """Return the configuration of the evaluations that a function runs, with these policies."""
    lists = {name: listed(given.get(name)) for name in ("tasks", "n_action_steps")}
    names = [entry if isinstance(entry, str) else entry.name for entry in entries] or None
    return configured(
        EvalConfig,
        config,
        {**given, **lists, "policies": names},
        folder="configs",
        start={"name": str(given.get("protocol") or "eval"), **start},
        needed={"tasks": "tasks", "policies": "policy"},
        where=where,
        edit=fill_from_protocol,
    )


def entries_of(policy: Any) -> list[str | PolicyEntry]:
    """Return names as they are, objects as entries."""
    if policy is None:
        return []
    if isinstance(policy, Mapping):
        return [
            _entry(found, str(name) if task is None else f"{name}:{task}")
            for name, value in policy.items()
            for task, found in (value.items() if isinstance(value, Mapping) else [(None, value)])
        ]
    several = policy if isinstance(policy, (list, tuple)) else [policy]
    return [_entry(one, None) for one in several]


def _entry(found: Any, name: str | None) -> str | PolicyEntry:
    if isinstance(found, (str, Path)):
        return str(found) if name is None else f"{name}={found}"
    if name is not None and ":" in name:
        raise RecipeError(
            f"policy '{name}': expected the folder of a checkpoint for each task, found {found!r:.80}. A "
            "policy object is given by itself: it gets its task in `reset`."
        )
    return given_entry(found, name=name)
