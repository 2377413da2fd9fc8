"""How far our ports are from the stored answers of the originals' code, in several precisions.

The networks and answers are the tiny ones of `tests/golden`. What the tests demand is beside each figure: it
holds in float32 on a CPU.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from own_tests import find_tests
from torch import Tensor


class Precision(NamedTuple):
    """A precision: `tf32` has an effect on GPUs only."""

    name: str
    dtype: torch.dtype
    tf32: bool


PRECISIONS = (
    Precision("float32", torch.float32, False),
    Precision("float32, TF32", torch.float32, True),
    Precision("bfloat16", torch.bfloat16, False),
)
Differences = dict[str, float]


def compare(device: str) -> dict[str, Any]:
    """Return the largest differences: model -> precision -> what was compared -> difference.

    Args:
        device: `cpu`, `cuda` …
    """
    find_tests()
    models: dict[str, Callable[[str, torch.dtype], Differences]] = {
        "openvla_oft": openvla_oft,
        "spatialvla": spatialvla,
        "octo": octo,
    }
    found: dict[str, Any] = {name: {} for name in models}
    for precision in _set_in_turn():
        for name, differences in models.items():
            with torch.no_grad():
                found[name][precision.name] = differences(device, precision.dtype)
    return {"largest_differences": found, "tolerances_in_tests": _tolerances()}


def _set_in_turn() -> Iterator[Precision]:
    """Yield the precisions, each while torch is set to it."""
    backends: Any = torch.backends
    before = backends.cuda.matmul.allow_tf32, backends.cudnn.allow_tf32
    for precision in PRECISIONS:
        backends.cuda.matmul.allow_tf32 = backends.cudnn.allow_tf32 = precision.tf32
        yield precision
    backends.cuda.matmul.allow_tf32, backends.cudnn.allow_tf32 = before


def _tolerances() -> dict[str, Differences]:
    from tests.models.octo import octo_golden
    from tests.models.openvla import openvla_golden
    from tests.models.spatialvla import spatialvla_golden

    return {
        "openvla_oft": {"actions": openvla_golden.TOLERANCE},
        "spatialvla": {"logits": spatialvla_golden.LOGITS, "share_of_other_tokens": 0.0},
        "octo": {"actions": octo_golden.TIGHT},
    }


def openvla_oft(device: str, dtype: torch.dtype) -> Differences:
    """Compare normalised actions; the head stays in float32, as the policy keeps it."""
    from tests.models.openvla import openvla_golden as golden
    from vla_eval.models.openvla.network import Inputs

    network = golden.network().to(device, dtype)
    network.action_head.float()
    inputs = Inputs(golden.images(2)[:1].to(device), _moved(golden.prompts("prompt1"), device))
    expected = golden.values()["infer.img2.prompt1.actions_normalized"]
    return {"actions": furthest(network.actions(inputs)[0], expected)}


def spatialvla(device: str, dtype: torch.dtype) -> Differences:
    """Compare logits of a prompt, and the tokens that follow it."""
    from tests.models.spatialvla import spatialvla_golden as golden
    from vla_eval.models.spatialvla.generation import generated_tokens

    network, values = golden.network().to(device, dtype), golden.values()
    inputs = _moved(golden.inputs([[0]], golden.prompts(0)), device)
    logits = network.logits(network.hidden(network.sequence(inputs), "bidirectional"))
    tokens = generated_tokens(network, inputs, chunk=golden.CHUNK, attention="bidirectional").tokens.cpu()
    return {
        "logits": furthest(logits, values["infer0.prefill_logits_all"]),
        "share_of_other_tokens": float((tokens != values["infer0.generated_ids"]).float().mean()),
    }


def octo(device: str, dtype: torch.dtype) -> Differences:
    """Compare the chunk that is sampled from stored noise; bfloat16 by autocast, as in a training."""
    from tests.models.octo import octo_golden as golden

    values, network = golden.values(), golden.make_network(golden.original_weights()).to(device)
    window, noise = _moved(golden.window(values, "w1"), device), golden.sampling_noise(values, "w1")
    kind = torch.device(device).type
    with torch.autocast(kind, dtype=torch.bfloat16, enabled=dtype != torch.float32):
        readout = network.transformer(window).readout_BWD[:, -1]
        chunk = network.head.sample(readout, noise.to(device))
    return {"actions": furthest(chunk, values["sample.w1.actions"])}


def furthest(found: Tensor, expected: Tensor) -> float:
    """Return the largest difference of two tensors of the same shape."""
    if found.shape != expected.shape:
        raise ValueError(f"expected a tensor of shape {tuple(expected.shape)}, found {tuple(found.shape)}")
    return float((found.float().cpu() - expected).abs().max())


def _moved(fields: Any, device: str) -> Any:  # Any: of the same type
    """Return tensors on the device, alone or in (named) tuples and dictionaries."""
    if isinstance(fields, Tensor):
        return fields.to(device)
    if isinstance(fields, dict):
        return {name: _moved(value, device) for name, value in fields.items()}
    if isinstance(fields, tuple):
        return type(fields)(*(_moved(value, device) for value in fields))
    return fields
