"""What a fine-tuning takes, before it is started: parameters, memory, steps, hours, and what is assumed."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple  # lerobot is untyped

import torch

from vla_eval.checkpoints.loading import make_unfilled_policy
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.evaluation.model_table import SUSTAINED_TFLOPS
from vla_eval.models.weights.empty import empty_weights
from vla_eval.training.cost.sample_cost import SampleCost, sample_cost
from vla_eval.training.policy_config import peft_config

KEPT_FREE = 0.05  # of a device's memory, for its runtime and fragmentation
CPU_TFLOPS = 0.1
ASSUMED_STEPS = 50
"""After so many steps, a training compares the assumed rate with its own."""
TERA = 1e12
GIB = 1 << 30
MODULE_DEPTH = 3  # of a parameter's name: deep enough to tell an action expert from a language model
OPTIMIZER_STATES = 2  # AdamW keeps two moments per trained parameter, in the parameter's type


class ModuleSize(NamedTuple):
    """Parameters of one part of the model."""

    name: str
    n_trained: int
    n_parameters: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelDescription:
    """The parts of a model, and the memory that weights, gradients and optimizer need."""

    modules: tuple[ModuleSize, ...]  # parts, largest first
    # `n_trained`, `n_parameters`: of the whole model
    n_trained: int
    n_parameters: int
    # `weights_bytes`, `training_bytes`: what weights take; what gradients and optimizer add
    weights_bytes: int
    training_bytes: int

    def lines(self) -> Iterable[str]:
        """Yield lines for a person, before the first step."""
        share = self.n_trained / self.n_parameters if self.n_parameters else 0.0
        yield f"trained: {self.n_trained:,} of {self.n_parameters:,} parameters ({share:.1%})"
        for module in self.modules:
            yield f"  {module.n_trained:>13,} of {module.n_parameters:>13,}  {module.name}"
        total = self.weights_bytes + self.training_bytes
        yield (
            f"memory, at least: {total / GIB:.2f} GiB = weights {self.weights_bytes / GIB:.2f} + gradients "
            f"and AdamW {self.training_bytes / GIB:.2f}; activations come on top and grow with batch_size"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """What a fine-tuning takes."""

    model: ModelDescription  # its parameters and the memory for weights, gradients and optimizer
    cost: SampleCost | None  # of a sample; None for a type of policy whose tokens are not known
    # `steps`, `batch_size`, `micro_batch_size`: of the recipe; the last is what passes through at once
    steps: int
    batch_size: int
    micro_batch_size: int
    tflops: float  # assumed rate of the device, 10^12 operations per second

    @property
    def fixed_bytes(self) -> int:
        """Weights, gradients and optimizer."""
        return self.model.weights_bytes + self.model.training_bytes

    @property
    def step_seconds(self) -> float | None:
        """Of a step at the assumed rate."""
        if self.cost is None:
            return None
        return self.batch_size * self.cost.step_operations / (self.tflops * TERA)

    def largest_batch(self, device_bytes: float) -> int | None:
        """Return how many samples fit at once: 0 if not even the model does, None if it is not known."""
        if self.cost is None:
            return None
        room = device_bytes * (1 - KEPT_FREE) - self.fixed_bytes
        return max(0, math.floor(room / self.cost.saved_bytes)) if self.cost.saved_bytes else None


def estimate(
    model: Any, policy: Any, recipe: FinetuneRecipe, *, device: str, tflops: float | None = None
) -> Estimate:
    """Estimate what a fine-tuning takes, at a rate of the device or a usual one; weights need no memory."""
    usual = CPU_TFLOPS if device == "cpu" else SUSTAINED_TFLOPS
    return Estimate(
        model=describe_model(model),
        cost=sample_cost(model, policy),
        steps=recipe.steps,
        batch_size=recipe.batch_size,
        micro_batch_size=recipe.micro_batch_size or recipe.batch_size,
        tflops=usual if tflops is None else tflops,
    )


def unfilled_model(policy: Any, recipe: FinetuneRecipe) -> Any:
    """Return the model that a recipe trains, with adapters where it has LoRA, without memory for weights."""
    return with_adapters(make_unfilled_policy(policy), recipe)


def with_adapters(model: Any, recipe: FinetuneRecipe) -> Any:
    """Return a model with adapters where the recipe has LoRA; they get no memory."""
    adapters = peft_config(recipe, model.config)
    if adapters is None:
        return model
    model.config.pretrained_path = Path(str(recipe.base_checkpoint))
    with empty_weights(), torch.no_grad():
        return model.wrap_with_peft(peft_cli_overrides=asdict(adapters))


def estimate_lines(found: Estimate, *, device_bytes: float | None) -> Iterator[str]:
    """Yield lines for a person, the assumptions last."""
    yield from found.model.lines()
    cost, seconds = found.cost, found.step_seconds
    samples = found.steps * found.batch_size
    yield f"steps: {found.steps:,} of {found.batch_size} samples, {samples:,} samples"
    if cost is None or seconds is None:
        yield "no estimate of activations and hours: the tokens of this type of policy are not known here"
        return
    total = found.fixed_bytes + found.micro_batch_size * cost.saved_bytes
    yield (
        f"memory, estimated: {total / GIB:.1f} GiB with {found.micro_batch_size} samples at once, whose "
        f"activations take {found.micro_batch_size * cost.saved_bytes / GIB:.1f} "
        f"({cost.saved_bytes / GIB:.3f} per sample)"
    )
    if device_bytes is not None:
        largest = found.largest_batch(device_bytes)
        yield f"largest batch in {device_bytes / 1e9:.0f} GB, estimated: {_fits(largest)}"
    yield (
        f"time, estimated: {found.steps * seconds / 3600:.1f} h ({seconds:.2f} s per step, "
        f"{found.batch_size * cost.step_operations / TERA:.1f} TFLOP) at {found.tflops:g} TFLOP/s"
    )
    yield (
        f"assumptions: the rate; {KEPT_FREE:.0%} of the device kept free; activations from the shapes of "
        "layers by a measured factor (vla_eval/training/cost/sample_cost.py); loading, decoding, attention "
        "scores and checkpoints not counted"
    )


def _fits(largest: int | None) -> str:
    if largest is None:
        return "not known"
    return str(largest) if largest else "none, not even one sample"


class RateWatch:
    """Compares the assumed rate with the real one, once, after the first steps of this process."""

    def __init__(self, found: Estimate, first_step: int, say: Any) -> None:
        self._found, self._first, self._say = found, first_step, say
        self._seconds: list[float] = []

    def on_step(self, step: int, seconds: float) -> None:
        """Take the duration of a step, loading included."""
        if len(self._seconds) >= ASSUMED_STEPS:
            return
        self._seconds.append(seconds)
        if len(self._seconds) < ASSUMED_STEPS:
            return
        # The first steps also fill caches and compile; the later half is what the rest will be like.
        later = self._seconds[ASSUMED_STEPS // 2 :]
        self._say(rate_line(self._found, sum(later) / len(later), self._found.steps - step))


def rate_line(found: Estimate, measured_s: float, n_left: int) -> str:
    """Return what the rate is, what was assumed, and what is left at the real one."""
    left = f"{n_left * measured_s / 3600:.1f} h left for {n_left:,} steps"
    if found.step_seconds is None or found.cost is None:
        return f"rate: {measured_s:.3f} s per step; {left}"
    reached = found.batch_size * found.cost.step_operations / measured_s / TERA
    return (
        f"rate: {measured_s:.3f} s per step, {reached:.2g} TFLOP/s; assumed were {found.step_seconds:.3f} s "
        f"at {found.tflops:g} TFLOP/s: {measured_s / found.step_seconds:.2f} times as long; {left}"
    )


def describe_model(model: Any) -> ModelDescription:  # Any: a torch module of lerobot's
    """Count the parameters of a model."""
    trained: dict[str, int] = {}
    total: dict[str, int] = {}
    weights_bytes = training_bytes = 0
    for name, parameter in model.named_parameters():
        part = ".".join(name.split(".")[:-1][:MODULE_DEPTH]) or name
        n, n_bytes = parameter.numel(), parameter.numel() * parameter.element_size()
        total[part] = total.get(part, 0) + n
        trained[part] = trained.get(part, 0) + (n if parameter.requires_grad else 0)
        weights_bytes += n_bytes
        training_bytes += n_bytes * (1 + OPTIMIZER_STATES) if parameter.requires_grad else 0
    return ModelDescription(
        modules=tuple(
            ModuleSize(part, trained[part], n)
            for part, n in sorted(total.items(), key=lambda item: (-item[1], item[0]))
        ),
        n_trained=sum(trained.values()),
        n_parameters=sum(total.values()),
        weights_bytes=weights_bytes,
        training_bytes=training_bytes,
    )
