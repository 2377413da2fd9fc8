"""OpenVLA-OFT from images, sentence and proprioception to the executed action, through `eval`'s adapter."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from tests.unit import openvla_golden as golden
from tests.unit.stored_frames import StoredFrames, context, executed
from vla_eval.policies import lerobot_inputs
from vla_eval.policies.lerobot_loading import LoadOptions, load_checkpoint
from vla_eval.policies.openvla.configuration_openvla import AUGMENTATION
from vla_eval.policies.openvla.convert import ConvertOptions, convert_openvla
from vla_eval.policies.openvla.paper_compat import make_openvla
from vla_eval.policies.openvla.prompt import prompt_text
from vla_eval.policies.steps.images import Size, centre_crop, resize_lanczos3
from vla_eval.policies.steps.normalization import Normalization, Normalizer

CAMERAS = ("base_camera", "hand_camera")
CHUNK: int = golden.config()["num_actions_chunk"]
CASES = [("img1.prompt1", 1, 0, False), ("img2.prompt1", 2, 0, False)]
CASES += [("img1.prompt2.proprio", 1, 1, True), ("img2.prompt2.proprio", 2, 1, True)]


def write_tokenizer(folder: Path) -> None:
    """Write a tokenizer in which the word wN has the number N; the words around an instruction have none."""
    from tokenizers import Tokenizer, models, normalizers, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    words = {**{f"w{n}": n for n in range(golden.SIZES.pad_token)}, "<pad>": golden.SIZES.pad_token}
    tokenizer: Any = Tokenizer(models.WordLevel(words, unk_token="<pad>"))
    around = prompt_text("|").split("|")
    tokenizer.normalizer = normalizers.Sequence([normalizers.Replace(text, "") for text in around])
    tokenizer.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    make: Any = PreTrainedTokenizerFast
    make(tokenizer_object=tokenizer, pad_token="<pad>").save_pretrained(str(folder))


def sentence(prompt: str) -> str:
    ids = golden.values()[f"in.{prompt}_input_ids"][0].tolist()
    return " ".join(f"w{n}" for n in ids if n != golden.SIZES.empty_token)


def converted(folder: Path, *, n_cameras: int, proprio: bool) -> Path:
    published = folder / "published"
    published.mkdir()
    write_tokenizer(published)
    weights = {name: value.contiguous() for name, value in golden.original_weights().items()}
    if not proprio:
        weights = {name: x for name, x in weights.items() if not name.startswith("proprio_projector")}
    save_file(weights, published / "model.safetensors")
    config = golden.config()
    statistics = {"action": config["action_statistics"], "proprio": config["proprio_statistics"]}
    (published / "dataset_statistics.json").write_text(json.dumps({"tiny": statistics}))
    (published / "config.json").write_text(json.dumps({"model_type": "openvla"}))
    fields = ("observation.images.base", "observation.images.wrist")[:n_cameras]
    options = ConvertOptions(
        head="l1",
        chunk_size=CHUNK,
        pictures=fields,
        picture_px=config["image_size"],
        proprio=golden.PROPRIO if proprio else 0,
        gripper="unit_open",
        image_augmentation=False,  # the stored images have the model's size and are not cropped
        sizes=golden.changed_sizes(),
        dtype="float32",
    )
    return convert_openvla(published, folder / "ours", options)


@pytest.mark.parametrize(("case", "n_cameras", "row", "proprio"), CASES)
def test_an_episode_executes_what_the_original_predicts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str, n_cameras: int, row: int, proprio: bool
) -> None:
    values = golden.values()
    frames = {name: values["in.images"][row, i][None].numpy() for i, name in enumerate(CAMERAS[:n_cameras])}
    env = StoredFrames(frames)
    raw = values["in.proprio_raw"][row].numpy().astype(np.float32)
    monkeypatch.setattr(lerobot_inputs, "proprioception", lambda _state: {"eef": raw})
    monkeypatch.setitem(lerobot_inputs.STATE_NAMES, "eef", tuple(f"x{i}" for i in range(len(raw))))
    checkpoint = converted(tmp_path, n_cameras=n_cameras, proprio=proprio)
    policy: Any = make_openvla(
        context(env, CHUNK), checkpoint=str(checkpoint), device="cpu", **({"state": "eef"} if proprio else {})
    )
    found = executed(env, policy, sentence(case.split(".")[1]), n_action_steps=CHUNK, n_steps=CHUNK)
    expected = values[f"infer.{case}.actions"].numpy().copy()
    expected[:, -1] = 2 * expected[:, -1] - 1  # 0 closed, 1 open to ManiSkill's -1 closed, 1 open
    close = 2 * golden.TOLERANCE  # 2 g - 1 doubles the gripper's
    np.testing.assert_allclose(env.asked, expected, atol=close, rtol=0)
    np.testing.assert_allclose(found, expected.clip(-1, 1), atol=close, rtol=0)


def test_images_are_resized_and_cropped_as_in_the_originals_evaluation() -> None:
    values = golden.values()
    levels = values["data.jpeg_decoded"].permute(2, 0, 1)[None].float()
    resized = resize_lanczos3(levels, Size(*values["data.resized"].shape[:2]))
    cropped = centre_crop(resized, AUGMENTATION.centre_area)
    for found, name in ((resized, "data.resized"), (cropped, "data.center_cropped")):
        difference = (found[0].permute(1, 2, 0) - values[name].float()).abs()
        assert float(difference.max()) <= 1  # of 255; from the README of the golden files


@pytest.mark.parametrize(("what", "prefix"), [("actions", ""), ("proprio", "proprio_")])
def test_training_targets_are_normalised_as_by_the_original(what: str, prefix: str) -> None:
    values = golden.values()
    raw = values[f"data.norm.{what}"]
    statistics = {name: values[f"data.norm.{prefix}{name}"] for name in ("q01", "q99")}
    mask = (True,) * raw.shape[1]
    if what == "actions":
        statistics |= {name: values[f"data.norm.{name}"] for name in ("min", "max")}
        mask = tuple(values["data.norm.mask"].tolist())
        assert (statistics["min"] == statistics["max"]).tolist().index(True) == 4  # which never moves
    spec = Normalization(kind="q01_q99", mask=mask, clip=True)
    found = Normalizer(spec, statistics, where="golden").normalize(raw)
    torch.testing.assert_close(found, values[f"data.norm.{prefix}normalised"], atol=1e-6, rtol=0)


def test_predictions_are_brought_back_as_by_the_original() -> None:
    values = golden.values()
    back = golden.action_normalizer().unnormalize(values["unnorm.normalized"].float())
    torch.testing.assert_close(back, values["unnorm.actions"].float(), atol=golden.TOLERANCE, rtol=0)


def test_proprioception_is_normalised_and_cut_as_in_the_originals_evaluation(tmp_path: Path) -> None:
    """Its mask leaves the last number alone, which is still cut: 1.18 becomes 1."""
    loaded = load_checkpoint(converted(tmp_path, n_cameras=1, proprio=True), LoadOptions(device="cpu"))
    statistics = golden.config()["proprio_statistics"]
    spec = loaded.policy.config.normalizations()["observation.state"]
    raw = golden.values()["in.proprio_raw"].float()
    assert not statistics["mask"][-1] and float(raw[:, -1].max()) > 1
    normalized = Normalizer(spec, statistics, where="golden").normalize(raw)
    torch.testing.assert_close(normalized, golden.values()["in.proprio"], atol=1e-6, rtol=0)
