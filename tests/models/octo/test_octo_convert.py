"""A checkpoint of the original Octo becomes one of ours, to train on; what is missing or differs is named."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from tests.models.octo.tiny_octo import GOLDEN, TINY, convert, our_name
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.cli.main import main
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.errors import CheckpointError
from vla_eval.models.octo.conversion import unpack
from vla_eval.training.finetune import finetune

N_BYTES = 260  # 256, three special tokens, and one to spare


def golden_fields() -> dict[str, Any]:
    config = json.loads((GOLDEN / "config.json").read_text())
    head, t5, stem = config["action_head"], config["t5"], config["stem"]
    return {
        "image_px": {name: camera["image_size"] for name, camera in config["cameras"].items()},
        **{"window": 4, "max_window": config["max_horizon"], "width": config["token_embedding_size"]},
        **{"layers": config["num_layers"], "heads": config["num_attention_heads"]},
        **{"mlp_width": config["mlp_dim"], "stem_channels": stem["features"]},
        **{"stem_features": stem["num_features"], "head_hidden": head["hidden_dim"]},
        **{"head_blocks": head["num_blocks"], "head_time": head["time_dim"]},
        **{"language_tokens": config["language_tokens"], "tokenizer_name": "bytes"},
        "t5": {
            **{"vocabulary": N_BYTES, "width": t5["d_model"], "key": t5["d_kv"]},
            **{"heads": t5["num_heads"], "layers": t5["num_layers"], "mlp_width": t5["d_ff"]},
            "buckets": t5["relative_attention_num_buckets"],
            "max_distance": t5["relative_attention_max_distance"],
        },
    }


def golden_weights() -> dict[str, Tensor]:
    """The stored parameters, the text encoder's vocabulary lengthened so that each byte has a row."""
    weights = dict(load_file(GOLDEN / "weights.safetensors"))
    key = "octo_transformer.task_tokenizers_language.hf_model.shared.embedding"
    weights[key] = torch.cat([weights[key], torch.ones(N_BYTES - len(weights[key]), weights[key].shape[1])])
    return weights


def write_statistics(folder: Path, **datasets: float) -> None:
    def numbers(mean: float) -> dict[str, Any]:
        return {"action": {"mean": [mean] * 7, "std": [0.5] * 7, "max": [1.0] * 7}, "num_transitions": 3}

    data = {name: numbers(mean) for name, mean in datasets.items()}
    (folder / "dataset_statistics.json").write_text(json.dumps(data))


def packed(value: Any) -> bytes:
    """Write msgpack with the longest form of each type; arrays as flax's extension 1."""
    if isinstance(value, dict):
        inner = b"".join(packed(key) + packed(x) for key, x in value.items())
        return b"\xdf" + struct.pack(">I", len(value)) + inner
    if isinstance(value, list):
        return b"\xdd" + struct.pack(">I", len(value)) + b"".join(packed(x) for x in value)
    if isinstance(value, str):
        return b"\xdb" + struct.pack(">I", len(value)) + value.encode()
    if isinstance(value, bytes):
        return b"\xc6" + struct.pack(">I", len(value)) + value
    if isinstance(value, int):
        return b"\xd3" + struct.pack(">q", value)
    array = np.ascontiguousarray(value)
    inner = packed([list(array.shape), array.dtype.name, array.tobytes()])
    return b"\xc9" + struct.pack(">I", len(inner)) + b"\x01" + inner


class TestOriginal:
    def test_both_layouts_become_the_same_checkpoint_that_verify_accepts(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        kept = golden_weights()
        tree: dict[str, Any] = {}
        for key, x in kept.items():
            parts = key.split(".")  # T5's names have more dots than its tree; the flat names are the same
            inner = tree
            for part in parts[:-1]:
                inner = inner.setdefault(part, {})
            inner[parts[-1]] = x.numpy()
        for layout in ("one", "two"):
            folder = tmp_path / layout
            folder.mkdir()
            write_statistics(folder, bridge=0.25, fractal=0.5)
            if layout == "one":
                save_file(kept, folder / "params.safetensors")
            else:
                (folder / "checkpoint").write_bytes(packed(tree))
            convert(
                folder,
                tmp_path / f"{layout}-out",
                gripper="unit_open",
                fields=golden_fields(),
                dataset="bridge",
            )
        first, second = (load_file(tmp_path / f"{x}-out" / "model.safetensors") for x in ("one", "two"))
        assert first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)
        # safetensors keeps one of the two names of T5's embeddings.
        named = {key.replace("language.encoder.embed_tokens", "language.shared") for key in first}
        assert named == {our_name(key) for key in kept}
        assert main(["checkpoint", "verify", "--verbose", str(tmp_path / "one-out")]) == 0
        said = capsys.readouterr().out
        assert "1 × 4 × 7 actions" in said and "action.mean, action.std" in said
        assert f"{sum(x.numel() for x in kept.values()):,}" in said

    def test_which_statistics_has_to_be_said_where_there_are_several(self, tmp_path: Path) -> None:
        write_statistics(tmp_path, bridge_dataset=0.0, fractal=0.0)
        save_file({"x": torch.zeros(1)}, tmp_path / "params.safetensors")
        with pytest.raises(CheckpointError, match="Did you mean 'bridge_dataset'"):
            convert(tmp_path, tmp_path / "out", gripper="unit_open", fields=TINY, dataset="bridge_datset")

    def test_the_gripper_has_to_be_said(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        arguments = ["convert-octo", str(tmp_path), "--size", "small", "--out", str(tmp_path / "out")]
        assert main(["checkpoint", *arguments]) == 1
        said = capsys.readouterr().err
        assert "encode the gripper (--gripper), found nothing" in said and "Traceback" not in said

    def test_a_tensor_that_lacks_or_has_another_shape_is_named(self, tmp_path: Path) -> None:
        flat = golden_weights()
        flat.pop("octo_transformer.readout_action_pos_embedding")
        flat["octo_transformer.obs_wrist_projection.bias"] = torch.zeros(3)
        save_file(flat, tmp_path / "params.safetensors")
        write_statistics(tmp_path, bridge=0.0)
        with pytest.raises(CheckpointError) as error:
            convert(tmp_path, tmp_path / "out", gripper="unit_open", fields=golden_fields(), dataset="bridge")
        assert "1 missing: network.transformer.readout_positions" in str(error.value)
        assert "network.transformer.projections.wrist.bias (expected (32,), found (3,))" in str(error.value)

    def test_layouts_that_are_not_read_are_named_with_what_to_do(self, tmp_path: Path) -> None:
        (tmp_path / "manifest.ocdbt").touch()
        write_statistics(tmp_path, bridge=0.0)
        with pytest.raises(CheckpointError, match="flatten_dict"):
            convert(tmp_path, tmp_path / "out", gripper="unit_open", fields=TINY, dataset="bridge")

    @pytest.mark.parametrize("data", [b"\xc1", b"\xdf\x00\x00\x00\x02", packed({"a": 1}) + b"\x00"])
    def test_damaged_msgpack_is_an_error(self, data: bytes) -> None:
        with pytest.raises(CheckpointError, match="not flax's msgpack"):
            unpack(data, where="x")


def test_from_a_converted_base_only_the_head_changes_and_the_statistics_are_the_datasets(
    recorded: Path, tmp_path: Path
) -> None:
    original, base, out = tmp_path / "original", tmp_path / "base", tmp_path / "run"
    original.mkdir()
    save_file(golden_weights(), original / "params.safetensors")
    write_statistics(original, bridge=0.25)
    convert(original, base, gripper="maniskill", fields=golden_fields(), dataset="bridge")
    short = {"steps": 1, "batch_size": 2, "save_every_steps": 1, "log_every_steps": 1, "num_workers": 0}
    finetune(
        FinetuneConfig(
            policy="octo_small",
            dataset=str(recorded),
            out=str(out),
            finetune={
                **{**short, "base_checkpoint": str(base), "decode_ahead": False},
                "policy": {"window": 3, "gripper_encoding": "unit_open", "scheduler_warmup_steps": 0},
            },
            device="cpu",
            allow_unreplayed=True,
        )
    )
    folder = find_checkpoint(out)
    before, after = (load_file(path / "model.safetensors") for path in (base, folder))
    changed = {key for key in before if not torch.equal(before[key], after[key])}
    assert changed and all(key.startswith("network.head.") for key in changed)
    for name in ("preprocessor", "postprocessor"):
        steps = json.loads((folder / f"policy_{name}.json").read_text())["steps"]
        ours = next(step for step in steps if str(step.get("registry_name")).startswith("mikasa_"))
        assert ours["config"]["gripper"]["encoding"] == "unit_open"  # the recipe's, not the base's
        mean = load_file(folder / ours["state_file"])["action/mean"]
        assert not torch.equal(mean, torch.full((7,), 0.25))
        expected = json.loads((recorded / "meta" / "stats.json").read_text())["action"]["mean"]
        torch.testing.assert_close(mean, torch.tensor(expected))
