"""Seconds of a training step, and how much of it waits for samples: our loop and LeRobot's own, in one run.

Both train the same recipe from the same weights on the same dataset, with the same batch size, for some
steps; the first of them are not counted. Each loop has a process of its own. LeRobot's is the function of
`lerobot-train` (v0.6.1, lerobot/scripts/lerobot_train.py).
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any  # lerobot is untyped

N_FIRST = 3  # steps in which caches are filled and kernels are chosen
Seconds = list[tuple[float, float]]
"""Of each step: until its samples were there, and for the update."""


def measure_loops(
    name: str, dataset: Path, out: Path, *, device: str, n_steps: int, changes: Mapping[str, Any]
) -> dict[str, Any]:
    """Return for each loop the median seconds of a step, and the share of them that waits for samples.

    `changes` are put on top of the recipe's section `finetune`.
    """
    from vla_eval.workers.children import python_command

    found: dict[str, Any] = {}
    for loop in LOOPS:
        folder = out / loop
        shutil.rmtree(folder, ignore_errors=True)
        words = ("--loop", loop, "--policy", name, "--dataset", str(dataset), "--out", str(folder))
        more = ("--device", device, "--steps", str(n_steps), "--changes", json.dumps(dict(changes)))
        command = python_command(str(Path(__file__).resolve()), *words, *more)
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"{loop}, {name}: ended with {done.returncode}: {done.stderr[-1500:]}")
        steps: Seconds = [tuple(step) for step in json.loads(done.stdout.splitlines()[-1])]
        counted = steps[N_FIRST:]
        waits, whole = sum(wait for wait, _ in counted), sum(map(sum, counted))
        found[loop] = {"step_seconds": median(map(sum, counted)), "share_waiting": waits / whole}
    found["ratio"] = found["lerobot"]["step_seconds"] / found["ours"]["step_seconds"]
    return found


def _ours(job: Any) -> Seconds:
    """Train by our loop."""
    from vla_eval.training.loop import Listeners, train

    steps: Seconds = []
    job.out.mkdir(parents=True)
    nothing: Callable[..., None] = lambda *_: None  # noqa: E731
    train(
        job,
        Listeners(
            on_model=nothing,
            on_sentence=nothing,
            on_metrics=lambda line: steps.append((line["dataloading_s"], line["update_s"])),
            on_checkpoint=nothing,
            on_step=nothing,
            is_stopping=lambda: False,
        ),
    )
    return steps


def _lerobots(job: Any) -> Seconds:
    """Train by lerobot's own loop."""
    from lerobot.scripts import lerobot_train
    from lerobot.utils.logging_utils import MetricsTracker

    from vla_eval.training.job import lerobot_config

    steps: Seconds = []

    class Noted(MetricsTracker):  # type: ignore[misc]  # lerobot is untyped
        def step(self) -> None:
            steps.append((self.dataloading_s.val, self.update_s.val))
            super().step()

    config = lerobot_config(job)
    config.save_checkpoint, config.log_freq, config.policy.push_to_hub = False, 0, False
    config.policy.pretrained_path = job.base
    lerobot_train.MetricsTracker = Noted
    lerobot_train.train(config)
    return steps


LOOPS: dict[str, Callable[[Any], Seconds]] = {"lerobot": _lerobots, "ours": _ours}


def main() -> int:
    """Train by one loop, and print the seconds of its steps as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--loop", choices=tuple(LOOPS), required=True)
    for flag in ("--policy", "--dataset", "--out", "--device"):
        parser.add_argument(flag, required=True)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--changes", type=json.loads, default={})
    args = parser.parse_args()
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    from vla_eval.config.finetuning import FinetuneConfig
    from vla_eval.training.job import training_job

    asked = {"steps": args.steps, "log_every_steps": 1, "save_every_steps": args.steps}
    config = FinetuneConfig(
        policy=args.policy,
        dataset=args.dataset,
        device=args.device,
        allow_unreplayed=True,
        finetune={**args.changes, **asked},
        out=args.out,
    )
    steps = LOOPS[args.loop](training_job(config))
    print(json.dumps(steps), file=sys.stdout)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
