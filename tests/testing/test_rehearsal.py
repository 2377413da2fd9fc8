"""A rehearsal writes random weights of a recipe's shapes, loads them strictly, acts, and leaves nothing."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from scipy.fft import idct
from transformers import AutoTokenizer

from tests.forked import run_forked
from vla_eval.checkpoints.fast_tokens import load_fast_tokenizer
from vla_eval.checkpoints.loading import make_unfilled_policy
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.errors import CheckpointError
from vla_eval.models.weights.file import write_weights
from vla_eval.testing import rehearsal
from vla_eval.testing.random_checkpoint import stand_in_config, write_checkpoint
from vla_eval.testing.rehearsal import RehearsalOptions, rehearse, rehearse_checkpoint
from vla_eval.training.request import load_finetune_recipe

pytestmark = pytest.mark.usefixtures("no_network")
BYTES_PER_NUMBER = 4  # of tiny recipes, all float32


@pytest.mark.sampled(7)
@pytest.mark.parametrize(
    ("recipe", "tiny"),
    [
        ("openvla_oft_tiny", False),
        ("spatialvla_tiny", False),
        pytest.param("octo_tiny", False, marks=pytest.mark.slow),
        ("pi0_expert", True),
        pytest.param("pi05_lora", True, marks=pytest.mark.slow),
        ("pi0_fast", True),
        ("smolvla", True),
        pytest.param("smolvla_frames", True, marks=pytest.mark.slow),
        ("pi05_memory_tokens", True),
    ],
)
def test_a_tiny_recipe_is_written_loaded_and_acts(recipe: str, tiny: bool, tmp_path: Path) -> None:
    folder = tmp_path / "rehearsal"
    found = rehearse(recipe, RehearsalOptions(folder=folder, tiny=tiny))
    assert not folder.exists()
    assert 0 < found.trained <= found.parameters
    header = 1_000_000
    assert found.parameters * BYTES_PER_NUMBER <= found.bytes + header
    assert found.bytes <= found.parameters * BYTES_PER_NUMBER + header
    assert set(found.peak_rss_bytes) == {"write", "load", "act"} and min(found.peak_rss_bytes.values()) > 0
    before = found.estimated  # by a network without memory, with adapters where the recipe has them
    assert (before.parameters, before.trained) == (found.parameters, found.trained)
    assert 0 <= found.bytes - before.bytes <= header
    assert before.peak_rss_bytes["load"] == found.before_bytes + before.bytes
    assert before.peak_rss_bytes["load"] < before.peak_rss_bytes["act"] < 2 * before.peak_rss_bytes["load"]
    assert f"of which the recipe trains {found.trained:,} (estimated {found.trained:,})" in found.lines()[1]
    assert set(found.seconds) == {"write", "load", "first_inference", "second_inference"}


def test_the_command_prints_json_and_stays_within_the_limit(tmp_path: Path) -> None:
    """In a process of its own: the memory of this one depends on the tests before."""
    arguments = ["openvla_oft_tiny", "--out", str(tmp_path / "r"), "--device", "cpu", "--format", "json"]
    command = ["checkpoint", "rehearse", *arguments]
    done = run_forked(f"from vla_eval.cli.main import main; raise SystemExit(main({command}))", tmp_path)
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert printed["is_within_limit"]
    assert {"parameters", "trained", "bytes", "peak_rss_bytes", "seconds"} <= printed.keys()
    assert printed["limit_bytes"] == int(1.15 * printed["bytes"] + 2e9)


def test_a_checkpoint_that_is_there_is_loaded_and_stays(tmp_path: Path) -> None:
    folder, options = tmp_path / "checkpoint", RehearsalOptions(folder=tmp_path / "unused")
    recipe = load_finetune_recipe(FinetuneConfig(policy="openvla_oft_tiny", dataset="none")).value
    folder.mkdir()
    config, tokenizer = stand_in_config(recipe, tmp_path, dtype=None, tiny=False)
    policy = make_unfilled_policy(config)
    write_checkpoint(folder, config, policy, tokenizer)
    on_a_gpu = rehearsal._estimate(policy, "cuda", 100, trained=5)
    n_weights = BYTES_PER_NUMBER * sum(x.numel() for x in policy.parameters())
    assert set(on_a_gpu.peak_rss_bytes) == {"write"}  # the weights are in the device's memory
    assert on_a_gpu.peak_device_bytes is not None and on_a_gpu.peak_device_bytes > n_weights
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    found = rehearse_checkpoint(folder, options)
    assert found.parameters == sum(x.numel() for x in policy.parameters()) and found.trained is None
    assert set(found.seconds) == {"load", "first_inference", "second_inference"}
    assert found.estimated.parameters == found.parameters and set(found.estimated.peak_rss_bytes) == {
        "load",
        "act",
    }
    assert "written" not in "\n".join(found.lines())
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before
    assert not options.folder.exists()


def test_a_folder_that_is_there_is_left_alone(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="exists already"):
        rehearse("octo_tiny", RehearsalOptions(folder=tmp_path))


@pytest.mark.slow
def test_stand_ins_for_the_tokenizers_of_pi0_fast_name_every_token_that_it_can_predict(
    tmp_path: Path,
) -> None:
    recipe = load_finetune_recipe(FinetuneConfig(policy="pi0_fast", dataset="none")).value
    config, folder = stand_in_config(recipe, tmp_path, dtype=None, tiny=False)
    read: Any = AutoTokenizer
    text = read.from_pretrained(str(folder))
    actions = load_fast_tokenizer(config.action_tokenizer_name)
    assert (text.vocab_size, len(actions.bpe_tokenizer), actions.min_token) == (257_152, 2_048, -354)
    last = text.convert_ids_to_tokens([257_151])
    assert text.convert_tokens_to_ids(last) == [257_151]
    chunk = np.linspace(-1, 1, 28).reshape(1, 4, 7)
    (ids,) = actions(chunk)
    characters = np.array([ord(x) for x in actions.bpe_tokenizer.decode(ids)]) + actions.min_token
    # Rounded coefficients are off by at most 0.05, and a cosine transform is orthonormal.
    np.testing.assert_allclose(idct(characters.reshape(4, 7) / 10, axis=0, norm="ortho"), chunk[0], atol=0.1)


def test_what_is_written_in_parts_is_what_safetensors_reads(tmp_path: Path) -> None:
    whole = {
        "a": torch.arange(12.0).reshape(3, 4),
        "b": torch.arange(5).to(torch.bfloat16),
        "empty": torch.zeros(0, 3),
        "scalar": torch.tensor(7),
    }
    described = {name: x.to("meta") for name, x in whole.items()}
    write_weights(tmp_path / "w.safetensors", described, lambda name: whole[name].reshape(-1).split(5))
    found = load_file(tmp_path / "w.safetensors")
    assert found.keys() == whole.keys()
    assert all(torch.equal(found[name], x) and found[name].dtype == x.dtype for name, x in whole.items())
    for parts in ([torch.zeros(11)], [torch.zeros(13)], [torch.zeros(12).half()]):
        with pytest.raises(CheckpointError, match="expected 12 numbers"):
            write_weights(
                tmp_path / "x.safetensors", {"a": described["a"]}, lambda _, wrong=parts: iter(wrong)
            )
