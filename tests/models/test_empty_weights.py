"""A model that is built without memory for its weights and then filled is the model that was saved."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from tests.checkpoints.small_checkpoints import pi0  # noqa: F401  a fixture
from vla_eval.checkpoints.loading import LoadOptions, load_weights, read_config
from vla_eval.errors import CheckpointError
from vla_eval.models.families import FAMILIES
from vla_eval.models.weights.empty import empty_weights
from vla_eval.models.weights.exact import put_weights
from vla_eval.models.weights.file import WeightFile
from vla_eval.testing.tiny_models import tiny_paligemma


def has_empty(module: nn.Module) -> bool:
    return any(parameter.is_meta for parameter in module.parameters())


class Tied(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.embedding = nn.Embedding(5, 3)
        self.head = nn.Linear(3, 5, bias=False)
        self.head.weight = self.embedding.weight
        self.frozen = nn.Linear(3, 3).requires_grad_(False)
        self.register_buffer("scale", torch.tensor([2.0]), persistent=False)
        self.register_buffer("count", torch.tensor([1.0]))


def empty() -> Tied:
    with empty_weights():
        return Tied()


def test_weights_have_no_memory_and_buffers_have_their_values() -> None:
    model = empty()
    assert has_empty(model) and all(parameter.is_meta for parameter in model.parameters())
    assert model.scale.item() == 2.0
    assert not has_empty(Tied())  # outside the context, torch is as it was


def test_a_shared_weight_stays_shared_through_moving_and_filling(tmp_path: Path) -> None:
    with empty_weights():
        model = Tied().to(torch.bfloat16)
    assert model.head.weight is model.embedding.weight
    assert model.embedding.weight.dtype == torch.bfloat16 and model.scale.dtype == torch.bfloat16
    whole = Tied().to(torch.bfloat16)
    weights = {name: x.clone() for name, x in whole.state_dict().items() if name != "head.weight"}
    save_file(weights, tmp_path / "model.safetensors")
    put_weights(model, WeightFile(tmp_path / "model.safetensors"), where="file")
    assert model.head.weight is model.embedding.weight
    assert all(torch.equal(x, whole.state_dict()[name]) for name, x in model.state_dict().items())
    assert [p.requires_grad for p in model.parameters()] == [p.requires_grad for p in whole.parameters()]


def test_two_values_for_one_shared_weight_are_refused() -> None:
    weights = Tied().state_dict()
    weights["head.weight"] = weights["head.weight"] + 1
    for model in (empty(), Tied()):
        with pytest.raises(CheckpointError, match=r"1 not taken over: head\.weight"):
            put_weights(model, weights, where="file")


def test_a_tensor_that_lacks_is_refused_although_all_empty_ones_look_alike() -> None:
    weights = {name: x for name, x in Tied().state_dict().items() if name != "frozen.weight"}
    with pytest.raises(CheckpointError, match=r"1 missing: frozen\.weight"):
        put_weights(empty(), weights, where="file")


def test_what_was_read_does_not_depend_on_the_file_any_more(tmp_path: Path) -> None:
    file = tmp_path / "model.safetensors"
    save_file({"a": torch.arange(1000.0)}, file)
    tensor = WeightFile(file)["a"]
    file.write_bytes(b"")  # a mapped file that shrinks would end the process
    assert torch.equal(tensor, torch.arange(1000.0))


def test_a_checkpoint_loads_to_the_same_bits_with_and_without_memory_beforehand(
    pi0: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = LoadOptions(device="cpu")
    with tiny_paligemma("pi0"):
        filled = load_weights(pi0, read_config(pi0, options), options)
        monkeypatch.setitem(FAMILIES, "pi0", replace(FAMILIES["pi0"], is_built_empty=False))
        built = load_weights(pi0, read_config(pi0, options), options)
    expected = load_file(pi0 / "model.safetensors")
    for policy in (filled, built):
        state = policy.state_dict()
        assert all(torch.equal(state[name], tensor) for name, tensor in expected.items())
    first, second = dict(filled.named_buffers()), dict(built.named_buffers())
    assert first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)
    assert not has_empty(filled)
