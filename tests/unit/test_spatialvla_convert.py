"""A checkpoint with the published names becomes one of ours; what is missing or differs is named."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.unit import spatialvla_golden as golden
from vla_eval.cli.main import main
from vla_eval.errors import CheckpointError
from vla_eval.policies.lerobot_loading import LoadOptions, load_checkpoint
from vla_eval.policies.spatialvla.action_grid import AXES
from vla_eval.policies.spatialvla.action_tokens import from_tokens
from vla_eval.policies.spatialvla.convert import GRID_PARTS, ConvertOptions, convert_spatialvla
from vla_eval.policies.spatialvla.depth import zoe_depth
from vla_eval.policies.spatialvla.generation import generated_tokens
from vla_eval.policies.spatialvla.sizes import NetworkSizes
from vla_eval.policies.spatialvla.weight_names import EMBEDDINGS, HEAD
from vla_eval.policies.verify import verify_checkpoint

SMALL = {**golden.SMALL, **golden.DEPTH}
OPTIONS = ConvertOptions(sizes=SMALL, dtype="float32", unnorm_key="mikasa")


@pytest.fixture(scope="module")
def _published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the published files' names, golden weights and a tiny ZoeDepth."""
    from transformers import PreTrainedTokenizerFast

    folder = tmp_path_factory.mktemp("published")
    torch.manual_seed(0)
    depth = {
        f"vision_zoe_model.{name}": x for name, x in zoe_depth(NetworkSizes(**SMALL)).state_dict().items()
    }
    weights = {**golden.original_weights(), **depth}
    names = sorted(weights)
    for index, part in enumerate((names[::2], names[1::2])):
        tensors = {name: weights[name].contiguous().clone() for name in part}
        save_file(tensors, folder / f"model-0000{index + 1}-of-00002.safetensors")
    config = {"text_config": {"hidden_size": 64}, "action_token_begin_idx": 40, "spatial_token_num": 138}
    (folder / "config.json").write_text(json.dumps(config))
    grid: dict[str, dict[str, list[float]]] = {"translation": {}, "rotation": {}}
    for name, edges in zip(AXES, golden.grid().edges, strict=True):
        grid[GRID_PARTS[name]][f"{name}_bins"] = list(edges)
    statistics = {"mikasa": golden.config()["statistics"]["mikasa"]}
    processor = {"action_chunk_size": 4, "bin_policy": grid, "statistics": statistics}
    (folder / "processor_config.json").write_text(json.dumps(processor))
    make: Any = PreTrainedTokenizerFast
    special = {"pad_token": "<pad>", "bos_token": "<bos>", "eos_token": "<eos>", "unk_token": "<unk>"}
    make(tokenizer_file=str(golden.FOLDER / "tokenizer.json"), **special).save_pretrained(str(folder))
    return folder


@pytest.fixture
def published(_published: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(_published, tmp_path / "published"))


def changed_json(file: Path, **fields: Any) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **fields}))


def changed_weights(folder: Path, **tensors: torch.Tensor | None) -> None:
    """Put tensors into the first file, or take them out of all."""
    for index, file in enumerate(sorted(folder.glob("*.safetensors"))):
        weights = {key: value for key, value in load_file(file).items() if key not in tensors}
        if index == 0:
            weights |= {key: value for key, value in tensors.items() if value is not None}
        save_file(weights, file)


def test_a_converted_checkpoint_says_what_the_original_says(published: Path, tmp_path: Path) -> None:
    out = convert_spatialvla(published, tmp_path / "ours", OPTIONS)
    loaded = load_checkpoint(out, LoadOptions(device="cpu"))
    batch = loaded.preprocessor(
        {
            "observation.images.base": golden.inputs([[1]], golden.prompts(1)).pictures[:, 0],
            "task": [golden.config()["prompts"][1]],
        }
    )
    given = golden.inputs([[1]], golden.prompts(1))
    inputs = loaded.policy._inputs(batch)
    torch.testing.assert_close(inputs.pictures, given.pictures)
    torch.testing.assert_close(inputs.intrinsics, given.intrinsics)
    assert torch.equal(inputs.prompts.ids, given.prompts.ids)
    inputs = inputs._replace(depth=given.depth)  # the original ran with this in the place of its own
    values = golden.values()
    with torch.no_grad():
        told = generated_tokens(loaded.policy.network, inputs, chunk=4, attention="bidirectional")
        depth_is_finite = torch.isfinite(loaded.policy.network.depth(given.pictures[:, 0])).all()
    assert torch.equal(told.tokens, values["infer1.generated_ids"]) and depth_is_finite
    ids = values["unnorm.ids"].reshape(1, 4, 3)
    actions = loaded.postprocessor(from_tokens(ids, loaded.policy.grid, loaded.policy.network.sizes).float())
    expected = values["unnorm.actions"].float()
    torch.testing.assert_close(actions[0, :, :6], expected[:, :6], atol=golden.ELSEWHERE, rtol=0)
    assert torch.equal(actions[0, :, 6], 2 * expected[:, 6] - 1)  # ManiSkill's gripper
    verified = verify_checkpoint(out, LoadOptions(device="cpu"))
    assert verified.chunk == (1, 4, 7) and {"action.q01", "action.q99"} <= set(verified.statistics)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unnorm_key": "mikassa"}, "Did you mean 'mikasa'"),
        ({"sizes": {**SMALL, "llm_depth": 3}}, "missing"),
        ({"sizes": {**SMALL, "llm_depth": 1}}, "unexpected"),
        ({"sizes": {**SMALL, "llm_mlp": 32}}, "of another shape"),
        ({"sizes": {**SMALL, "llm_width": 32}}, "hidden_size: expected 32, found 64"),
        ({"head": "own"}, "use `--head tied`"),
    ],
)
def test_what_does_not_fit_the_options_is_an_error(
    published: Path, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(CheckpointError, match=message):
        convert_spatialvla(published, tmp_path / "ours", dataclasses.replace(OPTIONS, **changes))
    assert not (tmp_path / "ours").exists()


@pytest.mark.parametrize(
    ("file", "fields", "message"),
    [
        ("processor_config.json", {"bin_policy": {"translation": {}}}, "edges of the action grid"),
        ("processor_config.json", {"action_chunk_size": None}, "action_chunk_size"),
        ("config.json", {"use_vision_zoe": False}, "use_vision_zoe: expected True"),
        ("config.json", {"vision_zoe_config": {"attractor_kind": "sum"}}, "attractor_kind: expected mean"),
    ],
)
def test_files_that_say_something_else_are_an_error(
    published: Path, tmp_path: Path, file: str, fields: dict[str, Any], message: str
) -> None:
    changed_json(published / file, **fields)
    with pytest.raises(CheckpointError, match=message):
        convert_spatialvla(published, tmp_path / "ours", OPTIONS)


def test_a_tokenizer_that_does_not_end_prompts_as_the_models_is_refused(
    published: Path, tmp_path: Path
) -> None:
    sizes = {**SMALL, "newline_token": 5}
    with pytest.raises(CheckpointError, match="end with the token 5"):
        convert_spatialvla(published, tmp_path / "ours", dataclasses.replace(OPTIONS, sizes=sizes))


def test_an_output_matrix_of_its_own_is_used_left_out_or_asked_about(published: Path, tmp_path: Path) -> None:
    embeddings, ours = golden.original_weights()[EMBEDDINGS], "network.lm_head.weight"
    changed_weights(published, **{HEAD: embeddings.clone()})
    same = convert_spatialvla(published, tmp_path / "same", OPTIONS)
    assert ours not in load_file(same / "model.safetensors")
    changed_weights(published, **{HEAD: embeddings + 1})
    with pytest.raises(CheckpointError, match="Choose with `--head`"):
        convert_spatialvla(published, tmp_path / "none", OPTIONS)
    # As the published config.json has it.
    changed_json(published / "config.json", text_config={"hidden_size": 64, "tie_word_embeddings": False})
    own = convert_spatialvla(published, tmp_path / "own", OPTIONS)
    assert torch.equal(load_file(own / "model.safetensors")[ours], embeddings + 1)
    assert verify_checkpoint(own, LoadOptions(device="cpu")).chunk == (1, 4, 7)


def test_the_command_names_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["checkpoint", "convert-spatialvla", str(tmp_path), "--out", str(tmp_path / "ours")]
    assert main(arguments) == 1
    assert "config.json" in capsys.readouterr().err
