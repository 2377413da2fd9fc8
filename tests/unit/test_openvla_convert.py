"""A checkpoint with the published names becomes one of ours; what is missing or not allowed is named."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from tests.unit import openvla_golden as golden
from vla_eval.errors import CheckpointError
from vla_eval.policies.lerobot_loading import LoadOptions, load_checkpoint
from vla_eval.policies.openvla.convert import ConvertOptions, convert_openvla
from vla_eval.policies.openvla.network import Inputs
from vla_eval.policies.steps.byte_tokenizer import byte_tokenizer
from vla_eval.policies.verify import verify_checkpoint

SIZES = {
    "image_px": 56,
    "dino_width": 32,
    "dino_depth": 3,
    "dino_heads": 2,
    "siglip_width": 48,
    "siglip_depth": 3,
    "siglip_heads": 3,
    "siglip_mlp": 96,
    "llm_width": 32,
    "llm_depth": 2,
    "llm_heads": 4,
    "llm_mlp": 64,
}
OFT = ConvertOptions(
    head="l1", chunk_size=8, proprio=8, sizes=SIZES, dtype="float32", unnorm_key="tiny", allow_pickled=True
)


@pytest.fixture
def published(tmp_path: Path) -> Path:
    """Return a folder as the OFT scripts leave it, with the golden weights."""
    folder = tmp_path / "published"
    weights = golden.original_weights()
    heads = ("action_head", "proprio_projector")
    save_parts = {key: value.contiguous() for key, value in weights.items() if not key.startswith(heads)}
    folder.mkdir()
    byte_tokenizer().save_pretrained(str(folder))
    names = sorted(save_parts)
    for index, part in enumerate((names[::2], names[1::2])):
        save_file({name: save_parts[name] for name in part}, folder / f"model-{index}.safetensors")
    for head in heads:
        tensors = {
            f"module.{key.removeprefix(f'{head}.')}": value
            for key, value in weights.items()
            if key.startswith(head)
        }
        torch.save(tensors, folder / f"{head}--50000_checkpoint.pt")
    proprio = {**golden.config()["proprio_statistics"], "mask": [True] * 8}
    statistics = {"tiny": {"action": golden.config()["action_statistics"], "proprio": proprio}}
    (folder / "dataset_statistics.json").write_text(json.dumps(statistics))
    (folder / "config.json").write_text(json.dumps({"model_type": "openvla"}))
    return folder


def options(**changes: Any) -> ConvertOptions:
    import dataclasses

    return dataclasses.replace(OFT, **changes)


def test_a_converted_checkpoint_says_what_the_original_says(published: Path, tmp_path: Path) -> None:
    out = convert_openvla(published, tmp_path / "ours", OFT)
    loaded = load_checkpoint(out, LoadOptions(device="cpu"))
    inputs = Inputs(golden.pictures(2)[1:], golden.prompts("prompt2"), golden.values()["in.proprio"][1:])
    with torch.no_grad():
        normalized = loaded.policy.network.actions(inputs)
    values = golden.values()
    expected = values["infer.img2.prompt2.proprio.actions_normalized"]
    torch.testing.assert_close(normalized[0], expected, atol=golden.TOLERANCE, rtol=0)
    actions = loaded.postprocessor(normalized)[0]
    expected = values["infer.img2.prompt2.proprio.actions"].float()
    torch.testing.assert_close(actions, expected, atol=golden.TOLERANCE, rtol=0)
    verified = verify_checkpoint(out, LoadOptions(device="cpu"))
    assert verified.chunk == (1, 8, 7)
    assert {"action.q01", "action.q99", "observation.state.q01"} <= set(verified.statistics)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"allow_pickled": False}, "only with allow_pickled"),
        ({"unnorm_key": "tinny"}, "Did you mean 'tiny'"),
        ({"head": "tokens", "proprio": 0, "sizes": {**SIZES, "llm_depth": 3}}, "missing"),
        ({"head": "tokens", "proprio": 0, "sizes": {**SIZES, "llm_depth": 1}}, "unexpected"),
        ({"head": "tokens", "proprio": 0, "sizes": {**SIZES, "llm_mlp": 32}}, "of another shape"),
    ],
)
def test_what_does_not_fit_is_an_error(
    published: Path, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(CheckpointError, match=message):
        convert_openvla(published, tmp_path / "ours", options(**changes))
    assert not (tmp_path / "ours").exists()


def test_a_plain_openvla_has_no_continuous_head(published: Path, tmp_path: Path) -> None:
    (published / "action_head--50000_checkpoint.pt").unlink()
    with pytest.raises(CheckpointError, match="convert it with head `tokens`"):
        convert_openvla(published, tmp_path / "ours", OFT)
