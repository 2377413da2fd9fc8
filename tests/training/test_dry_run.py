"""A dry run says what a fine-tuning takes, from shapes alone, and changes nothing."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn

from tests.training import tiny_trainings
from vla_eval.cli.main import main
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.models.families import family_of
from vla_eval.training import dry_run
from vla_eval.training.cost.estimate import ASSUMED_STEPS, RateWatch, estimate, unfilled_model
from vla_eval.training.cost.sample_cost import count, sample_cost
from vla_eval.training.dry_run import DryRunOptions, assumed_config, describe_finetuning
from vla_eval.training.finetune import finetune
from vla_eval.training.request import load_finetune_recipe

offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own
GEMMA_EMBEDDINGS = 257_152 * 2_048
"""Of PaliGemma: a published file has them once, lerobot's network twice, as input and as unused output."""


def recipe_of(policy: str) -> FinetuneRecipe:
    from vla_eval.config.finetuning import FinetuneConfig

    return load_finetune_recipe(FinetuneConfig(policy=policy, dataset="demos")).value


@pytest.mark.parametrize(
    ("policy", "published"),
    [
        # Bytes of the published float32 files (docs/hardware.md): 4 per number, and a header.
        ("pi0", 14_005_618_584 / 4),
        ("pi05", 14_467_165_872 / 4),
    ],
)
def test_the_pi0_family_has_the_published_number_of_parameters(policy: str, published: float) -> None:
    recipe = recipe_of(policy)
    model = unfilled_model(assumed_config(recipe), recipe)
    n_parameters = sum(x.numel() for x in model.parameters()) - GEMMA_EMBEDDINGS
    assert 0 < published - n_parameters < 50_000  # 812 names, shapes and offsets as JSON


def test_octo_and_openvla_have_the_published_number_of_parameters() -> None:
    octo, openvla = recipe_of("octo_small"), recipe_of("openvla_oft")
    model = unfilled_model(assumed_config(octo), octo)
    assert sum(x.numel() for x in model.parameters()) == 136_670_604  # with T5; docs/hardware.md
    assert sum(x.numel() for x in model.parameters() if x.requires_grad) == 1_703_564
    found = estimate(
        unfilled_model(assumed_config(openvla), openvla), assumed_config(openvla), openvla, device="cpu"
    )
    # LoRA of rank 32 (110 to 113 million, docs/openvla.md) and the head of 151 million.
    assert 110e6 < found.model.n_trained - 151_084_039 < 113e6


class Network(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.transformer = nn.ModuleDict({"fc": nn.Linear(10, 20)}).requires_grad_(False)
        self.head = nn.ModuleDict({"first": nn.Linear(20, 30), "last": nn.Linear(30, 7)})


def test_operations_and_activations_are_those_of_the_layers_that_gradients_reach() -> None:
    config: Any = SimpleNamespace(type="mikasa_octo", window=2)
    cost = sample_cost(Network(), config)
    assert cost is not None
    tokens = 16 + 337 * 2
    trunk, head = 2 * 10 * 20 * tokens, 2 * (20 * 30 + 30 * 7) * 2
    assert cost.inference_operations == trunk + head
    assert cost.step_operations == trunk + 3 * head  # forward; by weights and by inputs for the head alone
    kept, working = family_of(config.type).saved_per_linear * 2 * (20 + 30 + 30 + 7), tokens * (10 + 20)
    assert cost.saved_bytes == pytest.approx(4 * (kept + working))
    assert cost.inference_bytes == 4 * tokens * (10 + 20)  # no layer has more than one of these matrices
    assert sample_cost(Network(), SimpleNamespace(type="groot")) is None


def test_convolutions_and_attention_of_an_act_count_like_linear_layers() -> None:
    images = {name: SimpleNamespace(shape=(3, 64, 96)) for name in ("base", "wrist")}
    config: Any = SimpleNamespace(type="act", image_features=images, chunk_size=5)
    resnet = nn.ModuleDict({"conv1": nn.Conv2d(3, 8, 7, stride=2), "layer2": nn.Conv2d(8, 16, 3, stride=2)})
    encoder = nn.ModuleDict({"self_attn": nn.MultiheadAttention(16, 2), "linear1": nn.Linear(16, 32)})
    counted = count(nn.ModuleDict({"model": nn.ModuleDict({"backbone": resnet, "encoder": encoder})}), config)
    # Two images; the first convolution halves their edges, a second layer of ResNet has an eighth.
    first, second = 2 * 32 * 48, 2 * 8 * 12
    tokens = 2 * 2 * 3 + 2  # of a 32nd of the edges; the latent and the state
    assert counted.forward == 2 * (
        first * 3 * 8 * 7 * 7 + second * 8 * 16 * 3 * 3 + tokens * (16 * 48 + 16 * 16 + 16 * 32)
    )
    read_and_written = first * (4 * 3 + 8) + second * (4 * 8 + 16) + tokens * ((16 + 48) + 2 * 16 + (16 + 32))
    assert counted.saved == read_and_written


def sequence_config(*, image_px: int = 32, **fields: Any) -> Any:
    sizes: dict[str, Any] = {"window_steps": 7, "encoder": "keypoints", "core": "gru", "tokens_per_step": 1}
    images = {name: SimpleNamespace(shape=(3, image_px, image_px)) for name in ("base", "wrist")}
    return SimpleNamespace(
        type="mikasa_sequence", image_features=images, context_steps=5, **{**sizes, **fields}
    )


def test_the_cells_and_the_two_encoders_of_a_plain_network_count_for_each_of_its_steps() -> None:
    encoder = nn.ModuleDict(
        {"features": nn.Sequential(nn.Conv2d(3, 8, 8, stride=4)), "reads": nn.Linear(24, 6)}
    )
    parts = {"encoders": nn.ModuleList([encoder]), "core": nn.ModuleDict({"cells": nn.GRU(6, 6)})}
    counted = count(nn.ModuleDict({"network": nn.ModuleDict(parts)}), sequence_config())
    # Seven steps; a quarter of an image's edge in each direction.
    assert counted.forward == 2 * 7 * (8 * 8 * (3 * 8 * 8 * 8) + 24 * 6 + 2 * 6 * 18)
    assert counted.saved == 7 * (8 * 8 * (3 * 16 + 8) + (24 + 6) + 2 * (6 + 18))


@pytest.mark.parametrize(("kind", "n_steps"), [("mikasa_sequence", 7), ("mikasa_offline_rl", 1)])
def test_each_convolution_of_the_plain_encoder_has_the_places_of_its_own_output(
    kind: str, n_steps: int
) -> None:
    convolutions = [nn.Conv2d(3, 8, 8, stride=4), nn.ReLU(), nn.Conv2d(8, 8, 4, stride=2), nn.ReLU()]
    encoder = nn.Sequential(*convolutions, nn.Conv2d(8, 8, 3), nn.ReLU(), nn.Flatten(), nn.Linear(8, 6))
    places, images = [], torch.zeros(1, 3, 36, 36)
    for layer in encoder[:6]:
        images = layer(images)
        places.append(images[0, 0].numel())
    part = {"encoder": encoder} if n_steps == 1 else {"encoders": nn.ModuleList([encoder])}
    config = sequence_config(encoder="nature", image_px=36)
    config.type = kind
    counted = count(nn.ModuleDict({"network": nn.ModuleDict(part)}), config)
    convolved = 3 * 8 * 64 * places[0] + 8 * 8 * 16 * places[2] + 8 * 8 * 9 * places[4]
    assert counted.forward == 2 * n_steps * (convolved + 8 * 6)


def test_decision_transformer_reads_its_window_at_every_step_and_others_read_a_step_once() -> None:
    network = nn.ModuleDict({"network": nn.ModuleDict({"core": nn.ModuleDict({"feed": nn.Linear(4, 4)})})})
    for core, n_reads in (("decision_transformer", 5), ("rate", 1)):
        counted = count(network, sequence_config(core=core, tokens_per_step=3))
        assert counted.forward == 2 * 16 * 7 * 3 * n_reads


@pytest.mark.parametrize("policy", ["act", "diffusion", "memory", "recurrent", "elmur", "iql"])
def test_a_dry_run_estimates_the_batch_of_a_policy_from_scratch(
    policy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--policy", policy, "--dataset", "demos/RC3", "--device", "cpu", "--device-memory", "24GB"]
    assert main(["finetune", *arguments, "--dry-run"]) == 0
    assert "largest batch in 24 GB, estimated: " in capsys.readouterr().out


def test_a_named_memory_is_that_of_a_gpu_and_so_is_the_rate(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--policy", "memory", "--dataset", "demos/RC3", "--device-memory", "24GB", "--dry-run"]
    for device, rate in (("auto", "at 100 TFLOP/s"), ("cpu", "at 0.1 TFLOP/s")):
        assert main(["finetune", *arguments, "--device", device]) == 0
        assert rate in capsys.readouterr().out


def test_the_largest_batch_is_what_fits_beside_weights_gradients_and_optimizer() -> None:
    recipe = FinetuneRecipe(type="mikasa_octo", steps=100, batch_size=8)
    found = estimate(
        Network(), SimpleNamespace(type="mikasa_octo", window=2), recipe, device="cpu", tflops=2.0
    )
    n_frozen, n_trained = 10 * 20 + 20, 20 * 30 + 30 + 30 * 7 + 7
    assert found.fixed_bytes == 4 * (n_frozen + 4 * n_trained)  # weights; and gradient and AdamW's moments
    assert found.cost is not None
    device = (found.fixed_bytes + 3.5 * found.cost.saved_bytes) / 0.95
    assert found.largest_batch(device) == 3
    assert found.largest_batch(1.0) == 0
    assert found.step_seconds == pytest.approx(8 * found.cost.step_operations / 2e12)


def test_after_the_first_steps_the_real_rate_replaces_the_assumed_one_once() -> None:
    recipe = FinetuneRecipe(type="mikasa_octo", steps=1_050, batch_size=8)
    found = estimate(Network(), SimpleNamespace(type="mikasa_octo", window=2), recipe, device="cpu")
    lines: list[str] = []
    watch = RateWatch(found, 0, lines.append)
    for step in range(1, ASSUMED_STEPS + 20):
        watch.on_step(step, 100.0 if step <= ASSUMED_STEPS // 2 else 3.6)
    (line,) = lines
    assert "3.600 s per step" in line and "assumed were" in line and "1.0 h left for 1,000 steps" in line


def test_what_is_not_there_is_named_with_the_command_that_gets_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [
        "--policy",
        "octo_small",
        "--dataset",
        "demos/RC3",
        "--device-memory",
        "24GB",
        "--device",
        "cpu",
    ]
    assert main(["finetune", *arguments, "--dry-run"]) == 0
    printed = capsys.readouterr().out
    assert (
        "mikasa-vla checkpoint fetch octo_small" in printed and "not there: the dataset demos/RC3" in printed
    )
    assert "trained: 1,703,564 of 136,670,604" in printed
    assert "50,000 of 64 samples, 3,200,000 samples" in printed
    assert "largest batch in 24 GB, estimated:" in printed and "assumptions:" in printed
    assert list(tmp_path.iterdir()) == []


PALIGEMMA, ROWS = 2_923_466_480, 257_216  # paligemma-3b-pt-224 as published, and of its embeddings
PI0_FAST = PALIGEMMA + (2 * 257_152 - ROWS) * 2_048  # lerobot has the embeddings twice, of 257,152 rows


@pytest.mark.parametrize(
    ("policy", "trained"),
    [
        ("smolvla", "99,880,992 of 450,046,176"),
        pytest.param("pi0_fast", f"{PI0_FAST:,} of {PI0_FAST:,}", marks=pytest.mark.slow),
    ],
)
@pytest.mark.usefixtures("no_network")
def test_a_dry_run_needs_no_base_and_no_network(
    policy: str, trained: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--policy", policy, "--dataset", "demos/RC3", "--device", "cpu"]
    assert main(["finetune", *arguments, "--dry-run"]) == 0
    assert f"trained: {trained}" in capsys.readouterr().out


def test_a_dry_run_describes_the_real_dataset_and_leaves_no_folder(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    config = tiny_trainings.act(recorded, out)
    lines = "\n".join(describe_finetuning(config, DryRunOptions()))
    assert "55 frames begin a sample; 0.1 passes over them" in lines  # 4 steps of 2, of 13 + 14 + 15 + 13
    assert not out.exists()
    finetune(config)
    assert "resuming from step 4" in "\n".join(describe_finetuning(config, DryRunOptions()))


def test_a_size_of_memory_has_a_unit(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["finetune", "--policy", "act", "--dataset", "d", "--dry-run", "--device-memory", "80"])
    assert "expected a size such as 80GB" in capsys.readouterr().err


def test_no_memory_of_a_gpu_is_assumed_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert dry_run._memory_here() is None
