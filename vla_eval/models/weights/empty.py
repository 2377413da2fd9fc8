"""Build a model without memory for its weights; its buffers, which are in no checkpoint, are real."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any  # torch's modules hold anything

import torch
from torch import Tensor, nn

_register = nn.Module.register_parameter
_to = nn.Module.to
_apply = nn.Module._apply
_patching = threading.Lock()


@contextlib.contextmanager
def empty_weights() -> Iterator[None]:
    """Let modules built in this context have parameters on `meta`; not for several threads."""
    with _patching:
        nn.Module.register_parameter = _register_empty  # type: ignore[method-assign]
        nn.Module.to = _move_what_is_real  # type: ignore[method-assign,assignment]
        nn.Module._apply = _apply_to_empty  # type: ignore[method-assign]
        try:
            yield
        finally:
            nn.Module.register_parameter = _register  # type: ignore[method-assign]
            nn.Module.to = _to  # type: ignore[method-assign]
            nn.Module._apply = _apply  # type: ignore[method-assign]


def _register_empty(self: nn.Module, name: str, param: nn.Parameter | None) -> None:
    _register(self, name, param)
    registered = self._parameters[name]
    if registered is None or registered.is_meta:
        return
    empty = nn.Parameter(registered.detach().to("meta"), requires_grad=registered.requires_grad)
    # What libraries note on a parameter, such as whether it is initialised.
    empty.__dict__.update(registered.__dict__)
    self._parameters[name] = empty


def _move_what_is_real(self: nn.Module, *args: Any, **kwargs: Any) -> nn.Module:
    device, dtype, _, _ = torch._C._nn._parse_to(*args, **kwargs)

    def convert(tensor: Tensor) -> Tensor:
        new_dtype = dtype if dtype is not None and tensor.is_floating_point() else tensor.dtype
        return tensor.to(tensor.device if tensor.is_meta or device is None else device, new_dtype)

    return _apply_to_empty(self, convert)


def _apply_to_empty(self: nn.Module, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> nn.Module:
    """Apply to buffers as torch does; to parameters so that one that is shared stays shared."""
    done: dict[int, nn.Parameter] = {}
    for module in self.modules() if recurse else (self,):
        for name, parameter in module._parameters.items():
            if parameter is None:
                continue
            if id(parameter) not in done:
                done[id(parameter)] = parameter
                parameter.data = fn(parameter.data)
            module._parameters[name] = done[id(parameter)]
        for name, buffer in module._buffers.items():
            if buffer is not None:
                module._buffers[name] = fn(buffer)
    return self
