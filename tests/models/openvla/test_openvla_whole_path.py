"""OpenVLA-OFT from images, a sentence and the state to the executed action, by the evaluation's adapter."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import Tensor

from tests.models.openvla import openvla_golden as golden
from tests.models.stored_frames import StoredFrames, context, executed
from vla_eval.checkpoints.conversion import convert
from vla_eval.checkpoints.loading import LoadedPolicy, LoadOptions, load_checkpoint
from vla_eval.features import ACTION_KEY, CAMERA_KEYS, STATE_KEY
from vla_eval.models.openvla.conversion_options import OpenVLAOptions
from vla_eval.policies.lerobot import inputs as lerobot_inputs
from vla_eval.policies.lerobot.paper_compat import make_paper_compat

# The stored images have the model's size, and the original ran without the crop.
OPTIONS = OpenVLAOptions(
    chunk_size=golden.CHUNK,
    camera_px=golden.SIZES.image_px,
    sizes=golden.SMALL,
    dtype="float32",
    allow_pickled=True,
    gripper="unit_open",
    image_augmentation=False,
)
SENTENCES = {"prompt1": "pick", "prompt2": "nothing"}  # see `word_tokenizer`
CASES = {
    "img1.prompt1": "l1",
    "img2.prompt1": "l1",
    "img1.prompt2.proprio": "l1",
    "img2.prompt2.proprio": "l1",
    "img2.prompt1.discrete": "parallel_tokens",
}
CLOSE = 2 * golden.TOLERANCE  # 2 g - 1 doubles the gripper's


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return golden.write_published(tmp_path_factory.mktemp("published"))


def converted(published: Path, tmp_path: Path, case: str, **changes: Any) -> Path:
    options = dataclasses.replace(
        OPTIONS,
        head=CASES[case],
        pictures=tuple(CAMERA_KEYS.values())[: int(case[len("img")])],
        proprio=golden.PROPRIO if "proprio" in case else 0,
        **changes,
    )
    return convert("mikasa_openvla", published, tmp_path / "ours", options)


def loaded(published: Path, tmp_path: Path, case: str, **changes: Any) -> LoadedPolicy:
    return load_checkpoint(converted(published, tmp_path, case, **changes), LoadOptions(device="cpu"))


@pytest.mark.sampled(5)
@pytest.mark.parametrize("case", CASES)
def test_an_episode_executes_what_the_original_predicts(
    published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    values, prompt = golden.values(), case.split(".")[1]
    sample = list(SENTENCES).index(prompt)
    images = values["in.images"][sample].numpy()
    env = StoredFrames({name: images[i : i + 1] for i, name in enumerate(CAMERA_KEYS)})
    # The fixture's state has as many numbers as LIBERO's, and none of ours.
    names = tuple(f"s{i}" for i in range(golden.PROPRIO))
    state = values["in.proprio_raw"][sample].float().numpy()
    monkeypatch.setattr(lerobot_inputs, "state_names", lambda _arm: {"libero": names})
    monkeypatch.setattr(lerobot_inputs, "proprioception", lambda _state, _arm: {"libero": state})
    checkpoint = converted(published, tmp_path, case)
    policy: Any = make_paper_compat(context(env, golden.CHUNK), checkpoint=str(checkpoint), device="cpu")
    n_steps = golden.CHUNK
    found = executed(env, policy, SENTENCES[prompt], n_action_steps=n_steps, n_steps=n_steps)
    expected = values[f"infer.{case}.actions"].numpy().copy()
    expected[:, -1] = 2 * expected[:, -1] - 1  # not normalised: 0 closed to 1 open; ManiSkill: -1 to 1
    np.testing.assert_allclose(env.asked, expected, atol=CLOSE, rtol=0)
    np.testing.assert_allclose(found, expected.clip(-1, 1), atol=CLOSE, rtol=0)


@pytest.mark.parametrize(("is_cropped", "name"), [(False, "resized"), (True, "center_cropped")])
def test_an_image_of_another_size_is_resized_and_cropped_as_by_the_original(
    published: Path, tmp_path: Path, is_cropped: bool, name: str
) -> None:
    policy = loaded(published, tmp_path, "img1.prompt1", image_augmentation=is_cropped).policy
    image = golden.values()["data.jpeg_decoded"].permute(2, 0, 1)[None].float() / 255
    (key,) = policy.config.image_fields
    levels = policy._images({key: image}, changed=False)[0, 0] * 255
    expected = golden.values()[f"data.{name}"].permute(2, 0, 1).float()
    assert image.shape[-1] != expected.shape[-1]
    torch.testing.assert_close(levels, expected, atol=1, rtol=0)  # by the README of the golden files
    # Rounding instead of truncating would change a quarter of them by a level.
    assert float((levels.round() != expected).float().mean()) < 0.01


@pytest.mark.sampled(3)
@pytest.mark.parametrize("case", ["img1.prompt1", "img2.prompt1", "img2.prompt2.proprio"])
def test_the_loss_of_the_policy_and_its_parts_are_the_originals(
    published: Path, tmp_path: Path, case: str
) -> None:
    policy, values, prompts = (
        loaded(published, tmp_path, case).policy,
        golden.values(),
        golden.training_prompts(),
    )
    images = golden.images(len(policy.config.image_fields)).unbind(dim=1)
    batch: dict[str, Tensor] = {
        **dict(zip(policy.config.image_fields, images, strict=True)),
        OBS_LANGUAGE_TOKENS: prompts.ids,
        OBS_LANGUAGE_ATTENTION_MASK: prompts.mask,
        STATE_KEY: values["in.proprio"],
        ACTION_KEY: values["train.actions"],
    }
    loss, parts = policy.train().forward(batch)
    name = f"train.{case.split('.')[0]}" + (".proprio" if "proprio" in case else "")
    first, later = (float(values[f"{name}.l1_loss_{part}"]) for part in ("current_action", "next_actions"))
    assert loss.item() == pytest.approx(float(values[f"{name}.l1_loss"]), abs=golden.TOLERANCE)
    assert parts["l1_first_action"] == pytest.approx(first, abs=golden.TOLERANCE)
    n = golden.CHUNK
    others = (n * parts["l1"] - parts["l1_first_action"]) / (n - 1)
    assert others == pytest.approx(later, abs=golden.TOLERANCE)
