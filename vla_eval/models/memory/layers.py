"""Layers that parts of the positive control are made of."""

from torch import nn


def three_layers(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Return a map from numbers to numbers with two hidden layers."""
    return nn.Sequential(
        nn.Linear(inputs, hidden),
        nn.GELU(),
        nn.Linear(hidden, hidden),
        nn.GELU(),
        nn.Linear(hidden, outputs),
    )
