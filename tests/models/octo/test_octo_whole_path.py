"""Octo from images and a sentence to the executed action, through the evaluation's own adapter."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import Tensor

from tests.models.golden_values import GoldenValues
from tests.models.octo.test_octo_convert import golden_fields
from tests.models.octo.test_octo_parity import CONFIG, sampling_noise
from tests.models.octo.tiny_octo import GOLDEN, convert
from tests.models.stored_frames import StoredFrames, context, executed
from vla_eval.chunking import ChunkExecutor, ChunkingSpec
from vla_eval.core import ActionChunk, FloatArray, ObservationWindow
from vla_eval.latency import EpisodeDelays
from vla_eval.policies.lerobot import policy as lerobot
from vla_eval.specs import PolicySpec

CAMERAS = {"primary": "base_camera", "wrist": "hand_camera"}
CHUNK: int = CONFIG["action_head"]["action_horizon"]
PAD, END = 0, 1  # of T5
MEAN, DEVIATION = 0.05, 0.15  # so that no action is beyond what the environment takes
CLOSE = 2e-5  # twice the tolerance of samples: 2 g - 1 doubles the gripper's


@pytest.fixture(scope="module")
def io() -> GoldenValues:
    return GoldenValues(GOLDEN / "io.safetensors")


def write_tokenizer(folder: Path) -> Path:
    """Write a tokenizer in which the word wN has the number N, and which ends like T5's."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    words = {"<pad>": PAD, "</s>": END, **{f"w{n}": n for n in range(2, CONFIG["t5"]["vocab_size"])}}
    tokenizer: Any = Tokenizer(models.WordLevel(words, unk_token="<pad>"))
    tokenizer.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", END)])
    make: Any = PreTrainedTokenizerFast
    make(tokenizer_object=tokenizer, pad_token="<pad>", eos_token="</s>").save_pretrained(str(folder))
    return folder


def sentence(ids: Tensor) -> str:
    return " ".join(f"w{n}" for n in ids.tolist() if n not in (PAD, END))


def converted(folder: Path, *, window: int) -> Path:
    fields = {**golden_fields(), "window": window}
    # The stored frames have the model's size, so that nothing is resized; images are not cropped.
    fields |= {"augment": False}
    fields["t5"]["vocabulary"] = CONFIG["t5"]["vocab_size"]
    (folder / "original").mkdir()
    (folder / "original" / "params.safetensors").write_bytes((GOLDEN / "weights.safetensors").read_bytes())
    n_dims = CONFIG["action_head"]["action_dim"]
    action = {"mean": [MEAN] * n_dims, "std": [DEVIATION] * n_dims}
    (folder / "original" / "dataset_statistics.json").write_text(json.dumps({"action": action}))
    tokenizer = write_tokenizer(folder / "tokenizer")
    out = convert(
        folder / "original",
        folder / "ours",
        fields=fields,
        gripper="unit_open",
        tokenizer=str(tokenizer),
    )
    config = json.loads((out / "config.json").read_text())
    for camera, field in config["cameras"].items():  # frames here are as small as the model's
        px = CONFIG["cameras"][camera]["image_size"]
        config["input_features"][field]["shape"] = [3, px, px]
    (out / "config.json").write_text(json.dumps(config))
    return out


def in_environment(normalized: Tensor) -> FloatArray:
    """Return what the original's actions are to ManiSkill, whose gripper is -1 closed to 1 open."""
    actions = normalized.numpy().copy()
    actions[:, :-1] = actions[:, :-1] * DEVIATION + MEAN
    actions[:, -1] = 2 * actions[:, -1] - 1
    return actions


@pytest.mark.parametrize("case", ["w1", "wmax_padhist"])
@pytest.mark.parametrize("row", range(CONFIG["batch_size"]))
def test_an_episode_executes_what_the_original_samples(
    tmp_path: Path, io: GoldenValues, monkeypatch: pytest.MonkeyPatch, case: str, row: int
) -> None:
    """All frames of the stored window are seen before the last inference, whose actions are compared."""
    is_real = io[f"{case}.timestep_pad_mask"][row]
    n_frames = int(is_real.sum())
    env = StoredFrames(
        {name: io[f"in.image_{key}"][row, -n_frames:].numpy() for key, name in CAMERAS.items()}
    )
    n_action_steps = n_frames - 1 or CHUNK
    checkpoint = converted(tmp_path, window=len(is_real))
    policy = lerobot.make_lerobot(context(env, n_action_steps), checkpoint=str(checkpoint), device="cpu")
    monkeypatch.setattr(lerobot, "given_noise", lambda _seeds, _shape: sampling_noise(io, case)[row][None])
    n_before = n_frames - 1
    found = executed(
        env,
        policy,
        sentence(io["in.language_input_ids"][row]),
        n_action_steps=n_action_steps,
        n_steps=n_before + n_action_steps,
    )
    expected = in_environment(io[f"sample.{case}.actions"][row])[:n_action_steps]
    np.testing.assert_allclose(env.asked[n_before:], expected, atol=CLOSE, rtol=0)
    np.testing.assert_allclose(found[n_before:], expected.clip(-1, 1), atol=CLOSE, rtol=0)


@pytest.mark.parametrize("decay", [0.0, 0.5])
def test_an_ensemble_of_chunks_executes_the_originals_means(io: GoldenValues, decay: float) -> None:
    chunks = io[f"data.ensemble_w{decay}.chunks"].numpy()
    spec = ChunkingSpec(n_action_steps=1, mode="temporal_ensemble", ensemble_decay=decay)
    executor, found = ChunkExecutor(spec, EpisodeDelays(delay=0, seed=1, control_hz=20.0)), []
    for step, chunk in enumerate(chunks):
        executor.submit(step, ActionChunk(actions=chunk.astype(np.float32)), seconds=0.0)
        executed_now = executor.action(step)
        assert executed_now is not None
        found.append(executed_now.action)
    np.testing.assert_allclose(found, io[f"data.ensemble_w{decay}.executed"].numpy(), atol=1e-6, rtol=0)


def test_receding_horizon_executes_and_shows_what_the_originals_wrapper_does(io: GoldenValues) -> None:
    stored = {key: io[f"data.rhc.{key}"] for key in ("chunks", "executed", "rewards", "done")}
    windows, chunks = io["data.rhc.observation_index"], stored["chunks"].numpy().astype(np.float32)
    seen: list[list[int]] = []

    class Stored:
        spec = PolicySpec(name="stored", reads="every", cameras=(), states=(), chunk_size=chunks.shape[1])

        def reset(self, _episodes: object) -> None:
            seen.clear()

        def act(self, window: ObservationWindow) -> ActionChunk:
            seen.append([frame.step for frame in window.frames])
            return ActionChunk(actions=chunks[len(seen) - 1])

    env = StoredFrames({})
    n_steps, n_action_steps = len(stored["executed"]), chunks.shape[1]
    executed(env, Stored(), "act", n_action_steps=n_action_steps, n_steps=n_steps)  # type: ignore[arg-type]
    np.testing.assert_allclose(env.asked, stored["executed"].numpy(), atol=1e-6, rtol=0)
    # Its reward counts the steps of each chunk: the episode ends within the second.
    assert stored["rewards"].tolist() == [n_action_steps, n_steps - n_action_steps]
    assert stored["done"].tolist() == [False, True] and len(seen) == len(chunks)
    # After the first chunk the window is what the second inference is given; after the end there is none.
    assert seen[1][-windows.shape[1] :] == windows[0].tolist()
    assert windows[1].tolist() == [step + n_steps - n_action_steps for step in windows[0].tolist()]
