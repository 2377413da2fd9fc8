"""A checkpoint with the published names becomes one of ours; what is missing or differs is named."""

import copy
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from tests.models.golden_values import GoldenFields
from tests.models.spatialvla import spatialvla_golden as golden
from tests.models.stored_frames import StoredFrames, context, executed
from tests.training.fitted_policies import policy_config
from vla_eval.checkpoints.conversion import convert
from vla_eval.checkpoints.loading import LoadOptions, load_checkpoint
from vla_eval.checkpoints.verify import verify_checkpoint
from vla_eval.cli.main import main
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.errors import CheckpointError
from vla_eval.models.spatialvla.conversion import EMBEDDINGS, HEAD
from vla_eval.models.spatialvla.conversion_options import SpatialVLAOptions
from vla_eval.models.spatialvla.depth import PAD_PX
from vla_eval.models.spatialvla.described import _NOT_OF_ENCODER, _NOT_OF_ZOE, OF_NO_EFFECT, check_described
from vla_eval.models.spatialvla.ego3d import CENTRE_M
from vla_eval.models.spatialvla.generation import from_tokens
from vla_eval.models.spatialvla.network import FIRST_PLACE
from vla_eval.models.spatialvla.sizes import TOKENS_PER_ACTION, NetworkSizes
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.training.dataset import training_dataset

SMALL = {**golden.SMALL, **golden.DEPTH}
(UNNORM_KEY,) = golden.config()["statistics"]
OPTIONS = SpatialVLAOptions(sizes=SMALL, dtype="float32", unnorm_key=UNNORM_KEY)


@pytest.fixture(scope="module")
def _published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return golden.write_published(tmp_path_factory.mktemp("published"))


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


@pytest.fixture(scope="module")
def converted(_published: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = dataclasses.replace(OPTIONS, camera_px=golden.SIZES.image_px)
    return convert("mikasa_spatialvla", _published, tmp_path_factory.mktemp("converted") / "ours", options)


class StoredDepth(torch.nn.Module):
    """Says what the original's depth network was replaced by: the stored depth of each golden image."""

    def forward(self, images: Tensor) -> Tensor:
        values = golden.values()
        known = values["in.images"].permute(0, 3, 1, 2).float() / 255
        distances = (images[:, None] - known).abs().amax(dim=(2, 3, 4))
        assert float(distances.amin(dim=1).max()) < 1e-6
        return values["in.predicted_depth"][distances.argmin(dim=1)]


def test_an_episode_executes_what_the_original_predicts(converted: Path) -> None:
    values, statistics = golden.values(), golden.config()["statistics"][UNNORM_KEY]["action"]
    images = values["in.images"].numpy()
    env = StoredFrames({name: images for name in ("base_camera", "hand_camera")})
    policy = make_lerobot(context(env, golden.CHUNK), checkpoint=str(converted), device="cpu")
    policy._loaded.policy.network.depth = StoredDepth()
    for index, prompt in enumerate(golden.config()["prompts"]):
        shown = int(values[f"infer{index}.image_index"])
        env._frames = {name: images[shown : shown + 1] for name in env._frames}
        found = executed(
            env,
            policy,
            prompt,
            n_action_steps=golden.CHUNK,
            n_steps=golden.CHUNK,
        )
        expected = values[f"infer{index}.actions"].numpy().copy()
        assert not statistics["mask"][-1]  # of the gripper: 0 closed, 1 open
        expected[:, -1] = 2 * expected[:, -1] - 1  # ManiSkill's: -1 closed, 1 open
        np.testing.assert_allclose(found, expected.clip(-1, 1), atol=golden.ELSEWHERE, rtol=0)


def test_a_converted_checkpoint_predicts_as_the_original_without_being_told(converted: Path) -> None:
    loaded, values = load_checkpoint(converted, LoadOptions(device="cpu")), golden.values()
    assert json.loads((converted / "config.json").read_text())["inference_attention"] == "bidirectional"
    loaded.policy.network.depth = StoredDepth()
    given = golden.inputs([[1]], golden.prompts(1))
    batch = loaded.preprocessor(
        {"observation.images.base": given.images[:, 0], "task": [golden.config()["prompts"][1]]}
    )
    inputs = loaded.policy._inputs(batch)
    torch.testing.assert_close(inputs.images, given.images)
    torch.testing.assert_close(inputs.intrinsics, given.intrinsics)
    assert torch.equal(inputs.prompts.ids, given.prompts.ids)
    expected = from_tokens(
        values["infer1.generated_ids"].reshape(1, golden.CHUNK, -1), loaded.policy.grid, golden.SIZES
    )
    told = loaded.policy.predict_action_chunk(batch)
    torch.testing.assert_close(told, expected.float(), atol=golden.ELSEWHERE, rtol=0)
    # The trap: what our fine-tunings do is something else.
    loaded.policy.config.inference_attention = "causal"
    assert float((loaded.policy.predict_action_chunk(batch) - told).abs().max()) > 0.1


def test_what_is_fine_tuned_on_it_predicts_as_it_was_trained(converted: Path, recorded: Path) -> None:
    dataset = training_dataset(recorded, allow_unreplayed=True)
    for chosen, expected in (({}, "causal"), ({"inference_attention": "bidirectional"}, "bidirectional")):
        recipe = FinetuneRecipe(
            type="mikasa_spatialvla", policy={"action_grid": "kept", **chosen}, base_checkpoint=str(converted)
        )
        config = policy_config(recipe, dataset, device="cpu")
        assert (config.prefix_attention, config.inference_attention) == ("causal", expected)


def test_tokens_become_the_actions_of_the_original(published: Path, tmp_path: Path) -> None:
    out = convert("mikasa_spatialvla", published, tmp_path / "ours", OPTIONS)
    loaded, values = load_checkpoint(out, LoadOptions(device="cpu")), golden.values()
    ids = values["unnorm.ids"].reshape(1, golden.CHUNK, -1)
    actions = loaded.postprocessor(from_tokens(ids, loaded.policy.grid, golden.SIZES).float())
    expected = values["unnorm.actions"].float()
    torch.testing.assert_close(actions[0, :, :-1], expected[:, :-1], atol=golden.ELSEWHERE, rtol=0)
    assert torch.equal(actions[0, :, -1], 2 * expected[:, -1] - 1)  # ManiSkill's gripper
    with torch.no_grad():
        assert torch.isfinite(
            loaded.policy.network.depth(golden.inputs([[1]], golden.prompts(1)).images[:, 0])
        ).all()
    verified = verify_checkpoint(out, LoadOptions(device="cpu"))
    assert verified.chunk == (1, golden.CHUNK, 7) and {"action.q01", "action.q99"} <= set(verified.statistics)


def leaves(data: Any, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    if not isinstance(data, dict) or not data:
        return [path]
    return [leaf for key, value in data.items() for leaf in leaves(value, (*path, key))]


# What `check_described` does not compare, and why.
NOT_COMPARED = {
    ("processor_config.json", "action_chunk_size"): "used: it is the policy's",
    ("processor_config.json", "bin_policy"): "used: the edges of the grid",
    ("processor_config.json", "statistics"): "used: those of the chosen data",
    ("processor_config.json", "intrinsic_config"): "no effect: cameras are those of the evaluation",
    ("config.json", "text_config", "tie_word_embeddings"): "used: where Gemma's output matrix is",
    **{
        ("config.json", "text_config", f"{name}_token_id"): "no effect: told at the top"
        for name in ("pad", "bos", "eos")
    },
}


def test_every_field_of_the_files_is_compared_used_or_of_no_effect(published: Path) -> None:
    check_described(published, NetworkSizes(**SMALL))
    files = golden.published_files(golden.config(), SMALL)
    passed = {path for path in leaves(files) if not refused(published, files, path, "something else")}
    of_depth = OF_NO_EFFECT | _NOT_OF_ENCODER | _NOT_OF_ZOE
    zoe = {path for path in passed if "vision_zoe_config" in path}
    assert all(of_depth & set(path) for path in zoe)
    rest = [path for path in passed - zoe if not any(path[: len(known)] == known for known in NOT_COMPARED)]
    assert rest == []


@pytest.mark.parametrize(
    "path",
    [
        ("config.json", "text_config", "query_pre_attn_scalar"),
        ("config.json", "text_config", "rope_theta"),
        ("config.json", "vision_config", "vision_use_head"),
        ("config.json", "vision_zoe_config", "attractor_kind"),
        ("preprocessor_config.json", "do_normalize"),
        ("generation_config.json", "num_beams"),
    ],
)
def test_a_field_that_was_passed_over_is_named(published: Path, path: tuple[str, ...]) -> None:
    assert refused(published, golden.published_files(golden.config(), SMALL), path, 7) == [path[-1]]


def refused(folder: Path, files: dict[str, Any], path: tuple[str, ...], value: Any) -> list[str]:
    """Return the fields that are named once that of `path` says something else."""
    changed = copy.deepcopy(files[path[0]])
    inner = changed
    for key in path[1:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    (folder / path[0]).write_text(json.dumps(changed))
    try:
        check_described(folder, NetworkSizes(**SMALL))
    except CheckpointError as exc:
        return [line.split(": expected")[0].rsplit(".", 1)[-1] for line in str(exc).splitlines()[1:]]
    finally:
        (folder / path[0]).write_text(json.dumps(files[path[0]]))
    return []


def test_a_field_that_nobody_knows_is_refused_and_a_missing_one_means_the_originals_default(
    published: Path,
) -> None:
    files = golden.published_files(golden.config(), SMALL)
    assert refused(published, files, ("config.json", "text_config", "use_something"), 1) == ["use_something"]
    del files["config.json"]["text_config"]["query_pre_attn_scalar"]
    (published / "config.json").write_text(json.dumps(files["config.json"]))
    message = "query_pre_attn_scalar: expected 16, found nothing, which means 256"
    with pytest.raises(CheckpointError, match=message):
        check_described(published, NetworkSizes(**SMALL))


def test_every_field_of_the_fixtures_own_description_is_used_compared_or_of_no_effect() -> None:
    described = GoldenFields(golden.config())
    assert golden.sizes_of(described) == golden.sizes_of(golden.config())
    files = golden.published_files(described, SMALL)
    assert files == golden.published_files(golden.config(), SMALL)
    ego3d, llm, tokens = described["ego3d"], described["llm"], described["action_tokens"]
    assert (tuple(ego3d["center"]), ego3d["depth_pad"]) == (CENTRE_M, PAD_PX)
    assert llm["position_ids_start"] == FIRST_PLACE
    assert tokens["tokens_per_action"] == TOKENS_PER_ACTION and tokens["gripper_threshold"] == 0.5
    no_effect = {"model", "variant", "seed", "images_layout", "lm_head", "ego3d.depth_network"}  # words
    used_in_other_tests = {"prompts", "gradient_norm_order", "ego3d.depth_input_size", "adapted_gaussian"}
    left = {
        name
        for name in described.unread()
        if not name.startswith(("original.", "ran_with."))
        and not any(name == known or f".{known}." in f".{name}." for known in no_effect | used_in_other_tests)
    }
    assert left == set()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unnorm_key": "mikassa"}, "Did you mean 'mikasa'"),
        ({"sizes": {**SMALL, "llm_width": 32}}, "hidden_size: expected 32, found 64"),
        ({"head": "own"}, "use `--head tied`"),
    ],
)
def test_what_does_not_fit_the_options_is_an_error(
    published: Path, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(CheckpointError, match=message):
        convert("mikasa_spatialvla", published, tmp_path / "ours", dataclasses.replace(OPTIONS, **changes))
    assert not (tmp_path / "ours").exists()


@pytest.mark.parametrize(
    ("tensor", "message"), [(None, "missing"), (torch.zeros(3), "of another shape")], ids=["missing", "shape"]
)
def test_weights_that_are_not_those_of_the_network_are_an_error(
    published: Path, tmp_path: Path, tensor: Tensor | None, message: str
) -> None:
    changed_weights(published, **{EMBEDDINGS: tensor})
    with pytest.raises(CheckpointError, match=message):
        convert("mikasa_spatialvla", published, tmp_path / "ours", OPTIONS)
    changed_weights(published, **{"language_model.model.norm2.weight": torch.zeros(3)})
    with pytest.raises(CheckpointError, match="unexpected"):
        convert("mikasa_spatialvla", published, tmp_path / "ours", OPTIONS)


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
        convert("mikasa_spatialvla", published, tmp_path / "ours", OPTIONS)


def test_a_tokenizer_that_does_not_end_prompts_as_the_models_is_refused(
    published: Path, tmp_path: Path
) -> None:
    sizes = {**SMALL, "newline_token": 5}
    with pytest.raises(CheckpointError, match="end with the token 5"):
        convert("mikasa_spatialvla", published, tmp_path / "ours", dataclasses.replace(OPTIONS, sizes=sizes))


def test_an_output_matrix_of_its_own_is_used_left_out_or_asked_about(published: Path, tmp_path: Path) -> None:
    embeddings, ours = golden.original_weights()[EMBEDDINGS], "network.lm_head.weight"
    changed_weights(published, **{HEAD: embeddings.clone()})
    same = convert("mikasa_spatialvla", published, tmp_path / "same", OPTIONS)
    assert ours not in load_file(same / "model.safetensors")
    changed_weights(published, **{HEAD: embeddings + 1})
    with pytest.raises(CheckpointError, match="Choose with `--head`"):
        convert("mikasa_spatialvla", published, tmp_path / "none", OPTIONS)
    # As the published config.json has it.
    text = golden.published_files(golden.config(), SMALL)["config.json"]["text_config"]
    changed_json(published / "config.json", text_config={**text, "tie_word_embeddings": False})
    own = convert("mikasa_spatialvla", published, tmp_path / "own", OPTIONS)
    assert torch.equal(load_file(own / "model.safetensors")[ours], embeddings + 1)
    assert verify_checkpoint(own, LoadOptions(device="cpu")).chunk == (1, 4, 7)


def test_the_command_names_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["checkpoint", "convert-spatialvla", str(tmp_path), "--out", str(tmp_path / "ours")]
    assert main(arguments) == 1
    assert "config.json" in capsys.readouterr().err
