"""A checkpoint with the published names becomes one of ours; what is missing or not allowed is named."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.models.openvla import openvla_golden as golden
from vla_eval.checkpoints.conversion import convert
from vla_eval.checkpoints.loading import LoadOptions, load_checkpoint
from vla_eval.checkpoints.verify import verify_checkpoint
from vla_eval.cli.main import main
from vla_eval.errors import CheckpointError
from vla_eval.models.openvla.conversion import STATISTICS_FILE
from vla_eval.models.openvla.conversion_options import OpenVLAOptions
from vla_eval.models.openvla.network import Inputs

OFT = OpenVLAOptions(
    head="l1",
    chunk_size=golden.CHUNK,
    proprio=golden.PROPRIO,
    sizes=golden.SMALL,
    dtype="float32",
    unnorm_key=golden.UNNORM_KEY,
    allow_pickled=True,
    gripper="unit_open",
    image_augmentation=True,
)


@pytest.fixture(scope="module")
def _published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return golden.write_published(tmp_path_factory.mktemp("published"))


@pytest.fixture
def published(_published: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(_published, tmp_path / "published"))


def options(**changes: Any) -> OpenVLAOptions:
    return dataclasses.replace(OFT, **changes)


def changed_statistics(folder: Path, field: str, **statistics: Any) -> None:
    """Change statistics of a field; None takes one out."""
    file = folder / STATISTICS_FILE
    data = json.loads(file.read_text())
    changed = {**data[golden.UNNORM_KEY][field], **statistics}
    data[golden.UNNORM_KEY][field] = {key: value for key, value in changed.items() if value is not None}
    file.write_text(json.dumps(data))


def test_a_converted_checkpoint_has_the_originals_weights_and_statistics(
    published: Path, tmp_path: Path
) -> None:
    out = convert("mikasa_openvla", published, tmp_path / "ours", OFT)
    loaded, values = load_checkpoint(out, LoadOptions(device="cpu")), golden.values()
    inputs = Inputs(golden.images(2)[1:], golden.prompts("prompt2"), values["in.proprio"][1:])
    with torch.no_grad():
        normalized = loaded.policy.network.actions(inputs)
    expected = values["infer.img2.prompt2.proprio.actions_normalized"]
    torch.testing.assert_close(normalized[0], expected, atol=golden.TOLERANCE, rtol=0)
    verified = verify_checkpoint(out, LoadOptions(device="cpu"))
    assert verified.chunk == (1, golden.CHUNK, golden.ACTION)
    assert {"action.q01", "action.q99", "observation.state.q01"} <= set(verified.statistics)


def test_normalised_numbers_become_the_originals_actions_and_the_gripper_maniskills(
    published: Path, tmp_path: Path
) -> None:
    loaded = load_checkpoint(
        convert("mikasa_openvla", published, tmp_path / "ours", OFT), LoadOptions(device="cpu")
    )
    values = golden.values()
    actions = loaded.postprocessor(values["unnorm.normalized"][None].float())[0]
    expected = values["unnorm.actions"].float().clone()
    assert not golden.config()["action_statistics"]["mask"][-1]  # of the gripper, which stays 0 to 1 there
    expected[:, -1] = 2 * expected[:, -1] - 1
    torch.testing.assert_close(actions, expected, atol=golden.TOLERANCE, rtol=0)


def test_the_state_is_normalised_by_the_originals_mask(published: Path, tmp_path: Path) -> None:
    assert False in golden.config()["proprio_statistics"]["mask"]  # and what it leaves alone is cut, too
    loaded = load_checkpoint(
        convert("mikasa_openvla", published, tmp_path / "ours", OFT), LoadOptions(device="cpu")
    )
    values = golden.values()
    images = golden.images(2)
    batch = loaded.preprocessor(
        {
            "observation.images.base": images[:, 0],
            "observation.images.wrist": images[:, 1],
            "observation.state": values["in.proprio_raw"].float(),
            "task": ["pick", "pick"],
        }
    )
    torch.testing.assert_close(batch["observation.state"], values["in.proprio"], atol=1e-6, rtol=0)


def test_a_mask_of_actions_leaves_alone_what_it_says(published: Path, tmp_path: Path) -> None:
    changed_statistics(published, "action", mask=[True, False, *[True] * (golden.ACTION - 3), False])
    loaded = load_checkpoint(
        convert("mikasa_openvla", published, tmp_path / "ours", OFT), LoadOptions(device="cpu")
    )
    actions = loaded.postprocessor(torch.full((1, golden.CHUNK, golden.ACTION), 0.5))[0, 0]
    q01, q99 = (torch.tensor(golden.config()["action_statistics"][name]) for name in ("q01", "q99"))
    expected = q01 + 0.75 * (q99 - q01)  # 0.5 is three quarters of the way from -1 to 1
    expected[1] = 0.5
    expected[-1] = 0.0  # half open
    torch.testing.assert_close(actions, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mask": [True] * 3}, "expected 7 times true or false"),
        ({"mask": "all"}, "expected 7 times true or false, found 'all'"),
        ({"mask": [1] * 7}, "expected 7 times true or false"),
        # Without a mask the original normalises all, and so the gripper, too.
        ({"mask": None}, "a mask of the action that leaves the gripper alone"),
        ({"q01": None}, "no statistic 'q01'"),
    ],
)
def test_statistics_that_cannot_be_used_are_an_error(
    published: Path, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    changed_statistics(published, "action", **changes)
    with pytest.raises(CheckpointError, match=message):
        convert("mikasa_openvla", published, tmp_path / "ours", OFT)


class TestWhatNoFileSays:
    @pytest.mark.parametrize(
        ("stated", "message"), [(None, "nothing"), ("unit_opn", r"'unit_opn'\. Did you mean 'unit_open'\?")]
    )
    def test_the_gripper_has_to_be_said(
        self, published: Path, tmp_path: Path, stated: str | None, message: str
    ) -> None:
        with pytest.raises(CheckpointError, match=rf"encode the gripper \(--gripper\), found {message}"):
            convert("mikasa_openvla", published, tmp_path / "ours", options(gripper=stated))

    def test_the_command_line_says_so_in_one_message(
        self, published: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        arguments = ["checkpoint", "convert-openvla", str(published), "--out", str(tmp_path / "ours")]
        assert main(arguments) == 1
        said = capsys.readouterr().err
        assert "--gripper" in said and "unit_open: 0 closed to 1 open" in said and "Traceback" not in said
        assert main([*arguments, "--gripper", "unit_open"]) == 1
        assert "--image-aug yes or no" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("name", "stated", "expected"),
        [
            ("published", True, True),
            ("published", False, False),
            ("openvla-7b+mikasa+b8--image_aug--50000_chkpt", None, True),
            ("openvla-7b+mikasa+b8--image_aug--50000_chkpt", True, True),
        ],
    )
    def test_the_crop_goes_with_augmentation(
        self, published: Path, tmp_path: Path, name: str, stated: bool | None, expected: bool
    ) -> None:
        published = published.rename(tmp_path / name)
        out = convert("mikasa_openvla", published, tmp_path / "ours", options(image_augmentation=stated))
        assert json.loads((out / "config.json").read_text())["image_augmentation"] is expected

    @pytest.mark.parametrize(
        ("name", "stated", "message"),
        [
            ("published", None, "found nothing"),
            ("run--image_aug--1_chkpt", False, "--image-aug says no"),
        ],
    )
    def test_augmentation_has_to_be_known(
        self, published: Path, tmp_path: Path, name: str, stated: bool | None, message: str
    ) -> None:
        published = published.rename(tmp_path / name)
        with pytest.raises(CheckpointError, match=message):
            convert("mikasa_openvla", published, tmp_path / "ours", options(image_augmentation=stated))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"allow_pickled": False}, "only with allow_pickled"),
        ({"unnorm_key": "tinny"}, "Did you mean 'tiny'"),
        ({"head": "tokens", "proprio": 0, "sizes": {**golden.SMALL, "llm_depth": 3}}, "missing"),
        ({"head": "tokens", "proprio": 0, "sizes": {**golden.SMALL, "llm_depth": 1}}, "unexpected"),
        ({"head": "tokens", "proprio": 0, "sizes": {**golden.SMALL, "llm_mlp": 32}}, "of another shape"),
    ],
)
def test_what_does_not_fit_is_an_error(
    published: Path, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(CheckpointError, match=message):
        convert("mikasa_openvla", published, tmp_path / "ours", options(**changes))
    assert not (tmp_path / "ours").exists()


def test_a_plain_openvla_has_no_continuous_head(published: Path, tmp_path: Path) -> None:
    (published / "action_head--50000_checkpoint.pt").unlink()
    with pytest.raises(CheckpointError, match="convert it with head `tokens`"):
        convert("mikasa_openvla", published, tmp_path / "ours", OFT)
