"""`vla_eval.finetune`: `mikasa-vla finetune` from Python."""

from pathlib import Path
from typing import Any  # plain data

from vla_eval.api.configured import configured
from vla_eval.cli.finetune import finetune_with_progress
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.strict.calls import public
from vla_eval.training.request import FinetuneSummary


@public
def finetune(
    config: FinetuneConfig | str | Path | None = None,
    *,
    policy: str | None = None,
    dataset: str | Path | None = None,
    out: str | Path | None = None,
    steps: int | None = None,
    batch_size: int | None = None,
    base_checkpoint: str | Path | None = None,
    **fields: Any,
) -> FinetuneSummary:
    """Train a policy on a dataset, as `mikasa-vla finetune` does, in this process; the same call resumes.

    `evaluate(policy=str(summary.out))` evaluates the result.

    Args:
        config: a configuration, its file, or the name of one in `configs/`; None: the arguments say it all.
        policy: name of a recipe in `policies/` that has a section `finetune`.
        dataset: folder of one dataset, or a folder that holds one.
        out: the run folder; None: `runs/POLICY-DATASET-SEED`.
        steps: gradient steps; None: the recipe's.
        batch_size: samples per step; None: the recipe's.
        base_checkpoint: weights to start from.
        **fields: further fields of `FinetuneConfig`: `run_seed`, `device`, `held_out`, and `finetune`, a
            mapping with other values for the recipe's section.

    Raises:
        VlaEvalError: a mistake; what was saved stays.
        KeyboardInterrupt: Ctrl-C; a checkpoint was written.
    """
    base = None if base_checkpoint is None else str(base_checkpoint)
    section = {"steps": steps, "batch_size": batch_size, "base_checkpoint": base}
    changed = {name: value for name, value in section.items() if value is not None}

    def edit(data: dict[str, Any]) -> None:
        if isinstance(data.setdefault("finetune", {}), dict):  # anything else is refused when it is decoded
            data["finetune"] = {**data["finetune"], **changed}

    named = {"dataset": dataset, "out": out}
    paths = {name: None if path is None else str(path) for name, path in named.items()}
    read = configured(
        FinetuneConfig,
        config,
        {**fields, **paths, "policy": policy},
        folder="configs",
        start={},
        needed={"policy": "policy", "dataset": "dataset"},
        where="finetune",
        edit=edit,
    )
    summary, _ = finetune_with_progress(read, command="vla_eval.finetune(…)")
    if not summary.is_finished:
        raise KeyboardInterrupt(f"stopped at step {summary.step} in {summary.out}; the same call resumes")
    return summary
