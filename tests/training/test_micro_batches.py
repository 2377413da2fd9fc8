"""Gradient accumulation: less memory, the same gradient."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from accelerate import Accelerator

from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe
from vla_eval.errors import RecipeError, TrainingError
from vla_eval.training.finetune import finetune
from vla_eval.training.micro_batches import add_gradient


class Linear(torch.nn.Module):
    """Predicts actions from the state; its loss is a mean over samples."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(4, 2, dtype=torch.float64)
        self.seen: list[tuple[int, list[str]]] = []

    def forward(self, batch: dict[str, Any]) -> tuple[torch.Tensor, dict[str, Any]]:
        self.seen.append((len(batch["state"]), batch["task"]))
        errors = (self.layer(batch["state"]) - batch["action"]).square()
        return errors.mean(), {"largest": float(errors.mean(dim=1).max().detach()), "head": "l2"}


def batch_of(n: int) -> dict[str, Any]:
    drawn = torch.Generator().manual_seed(n)
    numbers = torch.randn(n, 6, generator=drawn, dtype=torch.float64)
    tasks = [f"task {index}" for index in range(n)]
    nested = {"frame": torch.arange(n), "fps": torch.tensor(20.0)}
    return {"state": numbers[:, :4], "action": numbers[:, 4:], "task": tasks, "info": nested, "none": None}


@pytest.fixture
def accelerator() -> Accelerator:
    return Accelerator(cpu=True)


@pytest.mark.parametrize("size", [1, 2, 3, 5, 8])
def test_the_gradient_and_the_loss_are_those_of_the_whole_batch(size: int, accelerator: Accelerator) -> None:
    policy, batch = Linear(), batch_of(5)
    whole, _ = policy(batch)
    whole.backward()
    assert policy.layer.weight.grad is not None
    expected = policy.layer.weight.grad.clone()
    policy.zero_grad()
    policy.seen.clear()

    loss = add_gradient(policy, batch, accelerator, size=size).value

    assert loss.item() == pytest.approx(whole.item(), rel=1e-12)
    torch.testing.assert_close(policy.layer.weight.grad, expected, rtol=1e-12, atol=1e-15)
    assert max(n for n, _ in policy.seen) == min(size, 5)
    assert [task for _, tasks in policy.seen for task in tasks] == batch["task"]


def test_what_the_policy_tells_is_averaged_over_samples(accelerator: Accelerator) -> None:
    policy, batch = Linear(), batch_of(3)
    errors = (policy.layer(batch["state"]) - batch["action"]).square().mean(dim=1)
    told = add_gradient(policy, batch, accelerator, size=2).parts
    errors = errors.detach()
    assert told["largest"] == pytest.approx(float(errors[:2].max() * 2 / 3 + errors[2] / 3))
    assert told["head"] == "l2"


def test_the_forward_pass_alone_is_under_autocast(accelerator: Accelerator) -> None:
    policy = Linear()
    during: list[tuple[str, bool]] = []
    for register, name in (
        (policy.layer.register_forward_hook, "forward"),
        (policy.layer.weight.register_hook, "backward"),
    ):
        register(lambda *_, name=name: during.append((name, torch.is_autocast_enabled("cpu"))))
    add_gradient(policy, batch_of(4), accelerator, size=2, autocast=torch.bfloat16)
    assert during == [("forward", True), ("backward", False)] * 2


def test_a_field_that_cannot_be_divided_is_named(accelerator: Accelerator) -> None:
    batch = {**batch_of(4), "mask": torch.ones(7)}
    with pytest.raises(TrainingError, match="'mask' has 7 entries, expected one for each of 4 samples"):
        add_gradient(Linear(), batch, accelerator, size=2)


@pytest.mark.parametrize("size", [0, 9])
def test_a_size_outside_the_batch_is_refused(size: int) -> None:
    with pytest.raises(RecipeError, match="expected a number from 1 to batch_size \\(8\\)"):
        FinetuneRecipe(type="act", batch_size=8, micro_batch_size=size)


@pytest.mark.usefixtures("small_act", "no_network")
def test_a_training_in_parts_begins_with_the_loss_and_gradient_of_a_whole_one(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    policy = {
        **{"chunk_size": 1, "n_action_steps": 1},  # no padding, by whose share ACT weighs samples
        **{"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1},
        **{"dropout": 0.0, "use_vae": False},  # draws nothing
    }
    lines = {}
    for micro_batch_size in (None, 2):
        out = tmp_path / str(micro_batch_size)
        short = {"steps": 1, "batch_size": 4, "save_every_steps": 1, "log_every_steps": 1, "num_workers": 0}
        short["micro_batch_size"] = micro_batch_size
        finetune(
            FinetuneConfig(
                policy="act",
                dataset=str(recorded),
                out=str(out),
                finetune={**short, "policy": policy},
                device="cpu",
                allow_unreplayed=True,
            )
        )
        lines[micro_batch_size] = json.loads((out / "metrics.jsonl").read_text().splitlines()[0])
    assert lines[2]["loss"] == pytest.approx(lines[None]["loss"], rel=1e-4)
    assert lines[2]["grad_norm"] == pytest.approx(lines[None]["grad_norm"], rel=1e-3)
