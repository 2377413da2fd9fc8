"""Describe what is trained, and the least memory that it needs. Knows only torch modules."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

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
