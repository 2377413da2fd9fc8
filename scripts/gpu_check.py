"""What to run on the first machine with a GPU: measures, writes gpu_check.json and a page of Markdown.

Each part is stored when it has ended; the same command resumes with the next one. A part that cannot run
here says why. `--device cpu --tiny` tries the script itself, in minutes, on tiny networks.
"""

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # torch's modules and lerobot's policies hold anything

ROOT = Path(__file__).resolve().parent.parent
TASK = "RememberColor3-v0"
SEEDS, RENDERED_STEPS = (1, 2), 10
BATCHES = (1, 8, 16)
TRAINING_STEPS = 5
EVALUATED_K = 8
GB = 1e9
REHEARSED = ("smolvla", "pi0", "pi05", "openvla_oft")
LEFT_OVER = ("rehearsal", "training")
LOOPS = {"act": False, "memory": False, "recurrent": False, "smolvla": True, "pi0_lora": True}
"""Recipe -> whether it begins from a base."""
LOOP_STEPS = 30
LORA = ("pi0_lora", "openvla_oft")
WITH_MEMORY = ("smolvla_frames", "pi05_frames", "pi05_memory_tokens")


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """How to check.

    Attributes:
        device: `cuda` or `cpu`.
        tiny: tiny networks and the fake simulator, to try the script.
        out: folder of the results.
    """

    device: str
    tiny: bool
    out: Path


class CannotRunError(Exception):
    """A part cannot run on this machine; the message says why."""


def doctor(check: Check) -> dict[str, Any]:
    """Return what `mikasa-vla doctor` prints."""
    done = _command("doctor", may_fail=True)
    return {"exit_code": done.returncode, "lines": done.stdout.splitlines()}


def rendering(check: Check) -> dict[str, Any]:
    """Compare frames of the GPU's renderer with the processor's, for the CPU simulator."""
    if check.tiny:
        raise CannotRunError("--tiny has no renderer: its simulator is a fake")
    import numpy as np

    renderers = ["cpu", "gpu" if check.device == "cuda" else "cpu"]
    own, other = (_in_its_own_process(renderer) for renderer in renderers)
    difference = np.abs(own.astype(np.int16) - other.astype(np.int16))
    return {
        "renderers": renderers,
        "frames": len(own),
        "share_of_pixels_that_differ": float((difference.max(axis=-1) > 0).mean()),
        "largest_difference_levels": int(difference.max()),
        "mean_difference_levels": float(difference.mean()),
    }


def rendering_speed(check: Check) -> dict[str, Any]:
    """Return control steps per second at K = 1, 4 and 8, as `mikasa-vla bench` measures them."""
    if check.tiny:
        raise CannotRunError("--tiny has no renderer: its simulator is a fake")
    return {"lines": _command("bench").stdout.splitlines()}


def golden(check: Check) -> dict[str, Any]:
    """Compare the tiny networks of the golden files with what the originals said, in several precisions."""
    from golden_differences import compare

    return compare(check.device)


def rehearsals(check: Check) -> dict[str, Any]:
    """Rehearse recipes at their published size, as far as memory allows."""
    return {name: _or_reason(lambda name=name: _rehearse(check, name)) for name in REHEARSED}


def training_steps(check: Check) -> dict[str, Any]:
    """Measure seconds of a training step: in full, with LoRA, with memory."""
    names = (*REHEARSED[:2], *LORA, *WITH_MEMORY)
    return {name: _or_reason(lambda name=name: _training(check, name)) for name in names}


def training_loops(check: Check) -> dict[str, Any]:
    """Measure our training loop against LeRobot's own: seconds per step, and how much of it waits."""
    from loop_speed import measure_loops

    dataset, n_steps = _demonstrations(check), 5 if check.tiny else LOOP_STEPS

    def measure(name: str, *, has_base: bool) -> dict[str, Any]:
        out, changes = check.out / "training" / name, {}
        if has_base:
            _write_random_checkpoint(out / "base", name)
            changes = {"base_checkpoint": str(out / "base")}
        return measure_loops(name, dataset, out, device=check.device, n_steps=n_steps, changes=changes)

    names = {"diffusion_small": False} if check.tiny else LOOPS
    return {
        name: _or_reason(lambda name=name, has_base=has_base: measure(name, has_base=has_base))
        for name, has_base in names.items()
    }


def _demonstrations(check: Check) -> Path:
    """Record demonstrations, if that was not done; return the dataset."""
    data = check.out / "demos"
    simulator = ["--set", "simulator=fake"] if check.tiny else []
    n = "3" if check.tiny else "50"
    _command("record", "--task", TASK, "--episodes", n, "--out", str(data), *simulator)
    return data / TASK


def short_training(check: Check) -> dict[str, Any]:
    """Record, train `memory` shortly, and evaluate it."""
    dataset, run = _demonstrations(check), check.out / "memory"
    few = check.tiny
    simulator = ["--set", "simulator=fake"] if few else []
    steps = ["--steps", "2" if few else "1000", "--set", "num_workers=0"]
    tiny = ["--set", "save_every_steps=2", "--set", "log_every_steps=1"] if few else []
    arguments = ["--policy", "memory", "--dataset", str(dataset), "--out", str(run), "--allow-unreplayed"]
    started = time.perf_counter()
    _command("finetune", *arguments, *steps, *tiny, "--device", check.device)
    seconds = time.perf_counter() - started
    episodes = ["--episodes", "1" if few else "50", "--n-action-steps", "4"]
    table = _command(
        "eval",
        "--task",
        TASK,
        "--policy",
        str(run),
        *episodes,
        *simulator,
        "--out",
        str(check.out / "evaluation"),
    )
    return {"training_seconds": seconds, "lines": table.stdout.splitlines()}


def whole_evaluations(check: Check) -> dict[str, Any]:
    """Evaluate a full-size policy of random weights in one server, as it is and compiled."""
    folder = check.out / "rehearsal"
    _write_random_checkpoint(folder / "model", "octo_tiny" if check.tiny else "pi0")
    return {
        name: _evaluated(check, folder / "model", compiles=compiles)
        for name, compiles in (("as it is", False), ("compiled", True))
        if not (check.tiny and compiles)  # it takes minutes on a CPU
    }


def _write_random_checkpoint(folder: Path, name: str) -> None:
    from vla_eval.checkpoints.loading import make_unfilled_policy
    from vla_eval.config.finetuning import FinetuneConfig
    from vla_eval.testing.random_checkpoint import stand_in_config, write_checkpoint
    from vla_eval.training.request import load_finetune_recipe

    fields = {"policy": {"chunk_size": EVALUATED_K, "n_action_steps": EVALUATED_K}}
    changes = fields if name == "pi0" else {}
    recipe = load_finetune_recipe(FinetuneConfig(policy=name, dataset="none", finetune=changes)).value
    folder.mkdir(parents=True)
    config, tokenizer = stand_in_config(recipe, folder.parent, dtype=None, tiny=False)
    write_checkpoint(folder, config, make_unfilled_policy(config), tokenizer)


def _evaluated(check: Check, model: Path, *, compiles: bool) -> dict[str, Any]:
    """Return episodes per minute, start-up included, and the shares of the workers' time."""
    from vla_eval.storage.timings import read_timings

    n_workers = len(os.sched_getaffinity(0))
    out = check.out / f"evaluation-{'compiled' if compiles else 'plain'}"
    shutil.rmtree(out, ignore_errors=True)
    settings = {"inference": "shared", "inference_max_batch": n_workers, "compile": str(compiles).lower()}
    if check.tiny:
        settings["simulator"] = "fake"
    started = time.perf_counter()
    table = _command(
        *("eval", "--task", TASK, "--policy", f"random_weights={model}", "--workers", str(n_workers)),
        *("--n-action-steps", "4" if check.tiny else str(EVALUATED_K), "--out", str(out)),
        *("--episodes", "2" if check.tiny else "100"),
        *(word for name, value in settings.items() for word in ("--set", f"{name}={value}")),
    )
    seconds = time.perf_counter() - started
    timings = read_timings(out).values()
    total = sum(timing.total_seconds for timing in timings)
    return {
        "seconds": seconds,
        "episodes_per_minute": 60 * len(timings) / seconds,
        "share_of_inference": sum(timing.inference_seconds for timing in timings) / total,
        "share_of_steps_and_frames": sum(timing.step_seconds for timing in timings) / total,
        "share_of_resets": sum(timing.reset_seconds for timing in timings) / total,
        "lines": table.stdout.splitlines(),
    }


def gpu_simulator(check: Check) -> dict[str, Any]:
    """Run the tests of the GPU simulator."""
    if check.device != "cuda":
        raise CannotRunError("no GPU was asked for (--device cpu)")
    from vla_eval.workers.children import python_command

    command = python_command("-m", "pytest", "-n", "0", "-q", "-m", "gpu", "tests/gpu")
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return {"exit_code": done.returncode, "lines": done.stdout.splitlines()[-5:]}


PARTS: dict[str, Callable[[Check], dict[str, Any]]] = {
    part.__name__: part
    for part in (
        doctor,
        rendering,
        rendering_speed,
        golden,
        rehearsals,
        training_steps,
        training_loops,
        short_training,
        whole_evaluations,
        gpu_simulator,
    )
}


def main() -> int:
    """Run the parts that have no result yet; return 1 if one failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--tiny", action="store_true", help="tiny networks, to try the script")
    parser.add_argument("--out", type=Path, default=Path("runs/gpu_check"), metavar="DIR")
    parser.add_argument("--part", nargs="+", choices=tuple(PARTS), default=tuple(PARTS), metavar="NAME")
    args = parser.parse_args()
    check = Check(device=args.device, tiny=args.tiny, out=args.out)
    check.out.mkdir(parents=True, exist_ok=True)
    file = check.out / "gpu_check.json"
    results: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {"machine": _machine(check)}
    for name in args.part:
        if results.get(name, {}).get("state") in ("done", "cannot run"):
            continue
        print(f"{name} …", file=sys.stderr, flush=True)
        for rest in LEFT_OVER:  # of a call that was killed
            shutil.rmtree(check.out / rest, ignore_errors=True)
        results[name] = _run(PARTS[name], check)
        temporary = file.with_suffix(".tmp")
        temporary.write_text(f"{json.dumps(results, indent=2)}\n")
        os.replace(temporary, file)
        (check.out / "gpu_check.md").write_text(page(results))
    print(check.out / "gpu_check.md")
    return int(any(part.get("state") == "failed" for part in results.values()))


def page(results: dict[str, Any]) -> str:
    """Return the results as Markdown, ready for docs/hardware.md."""
    machine = results["machine"]
    lines = [f"## {machine['device']}, measured {machine['date']}", ""]
    if machine["tiny"]:
        lines += ["Tiny networks: these figures only show that the script runs.", ""]
    for name in PARTS:
        part = results.get(name)
        if part is not None:
            lines += [f"### {name.replace('_', ' ')}", "", f"{part['state']} in {part['seconds']:.0f} s", ""]
            lines += ["```json", json.dumps(part.get("result", part.get("why")), indent=1), "```", ""]
    return "\n".join(lines)


def _run(part: Callable[[Check], dict[str, Any]], check: Check) -> dict[str, Any]:
    started = time.perf_counter()
    try:
        found: dict[str, Any] = {"state": "done", "result": part(check)}
    except CannotRunError as exc:
        found = {"state": "cannot run", "why": str(exc)}
    except Exception as exc:  # the next part may still be measured
        found = {"state": "failed", "why": f"{type(exc).__name__}: {exc!s:.2000}"}
    return {**found, "seconds": time.perf_counter() - started}


def _or_reason(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what was measured, or why a model cannot be measured here."""
    import torch

    from vla_eval.errors import VlaEvalError

    try:
        return measure()
    except (CannotRunError, VlaEvalError, torch.OutOfMemoryError) as exc:
        return {"cannot run": f"{exc!s:.500}"}


def _rehearse(check: Check, name: str) -> dict[str, Any]:
    from vla_eval.testing.rehearsal import RehearsalOptions, rehearse

    with _small(check, name) as (recipe, tiny):
        options = RehearsalOptions(folder=check.out / "rehearsal", device=check.device, tiny=tiny)
        found = rehearse(recipe, options, batches=BATCHES)
    return found.data()


def _training(check: Check, name: str) -> dict[str, Any]:
    from training_speed import measure_steps

    with _small(check, name) as (recipe, tiny):
        folder = check.out / "training"
        return measure_steps(recipe, folder, device=check.device, n_steps=TRAINING_STEPS, tiny=tiny)


@contextlib.contextmanager
def _small(check: Check, name: str) -> Iterator[tuple[str, bool]]:
    """Yield the recipe to measure, and whether it is built in its tiny form."""
    has_own = name.startswith("openvla")
    yield ("openvla_oft_tiny" if check.tiny and has_own else name, check.tiny and not has_own)


def _in_its_own_process(renderer: str) -> Any:
    """Return `_frames(renderer)`: the first to render in a process chooses its device."""
    from vla_eval.errors import RenderingError
    from vla_eval.workers.start import child_context

    with child_context().Pool(1) as pool:
        try:
            return pool.apply(_frames, (renderer,))
        except RenderingError as exc:
            raise CannotRunError(f"the renderer '{renderer}' is not there: {exc}") from None


def _frames(renderer: Any) -> Any:
    """Return the frames of both cameras, (N, H, W, 3) uint8, of the same seeds and actions."""
    import numpy as np

    from vla_eval.config.environment import EnvSettings, RenderSettings
    from vla_eval.envs.factory import make_env

    settings = EnvSettings(
        task=TASK, render=RenderSettings(backend=renderer), cameras=("base_camera", "hand_camera")
    )
    env = make_env(settings)
    frames = []
    for seed in SEEDS:
        results = env.reset({0: seed}, render=True)
        for _ in range(RENDERED_STEPS):
            frames += list(results[0].observation.images.values())
            results = env.step({0: env.hold_action(0)}, render=frozenset({0}))
    env.close()
    return np.stack(frames)


def _command(*arguments: str, may_fail: bool = False) -> "subprocess.CompletedProcess[str]":
    from vla_eval.workers.children import python_command

    command = python_command("-m", "vla_eval.cli", *arguments)
    done = subprocess.run(command, cwd=Path.cwd(), capture_output=True, text=True, check=False)
    if done.returncode != 0 and not may_fail:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr[-1500:]}")
    return done


def _machine(check: Check) -> dict[str, Any]:
    import torch

    from vla_eval.storage.provenance import collect_environment

    name = torch.cuda.get_device_name() if check.device == "cuda" else "CPU"
    return {
        "device": name,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "tiny": check.tiny,
        "environment": collect_environment(),
    }


if __name__ == "__main__":
    raise SystemExit(main())
