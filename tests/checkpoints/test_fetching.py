"""A base is fetched from a stand-in for the Hub, whole or not at all; nothing here leaves this machine."""

import dataclasses
import json
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import huggingface_hub.constants
import pytest
import torch
import torchvision
from huggingface_hub import HfApi
from safetensors.torch import load_file, save_file
from torchvision.models.resnet import BasicBlock

from tests.checkpoints.hub_stand_in import COMMIT, Hub, serving
from tests.checkpoints.small_checkpoints import pi0  # noqa: F401  a fixture
from tests.models.openvla import openvla_golden as golden
from vla_eval.checkpoints import fetching
from vla_eval.checkpoints.backbones import fetched_backbones
from vla_eval.checkpoints.bases import base_of_recipe, find_base
from vla_eval.checkpoints.files import BASE_FILE, checkpoint_sha256, find_checkpoint
from vla_eval.checkpoints.loading import LoadOptions
from vla_eval.checkpoints.verify import verify_checkpoint
from vla_eval.cli.main import main
from vla_eval.config.files import list_recipes
from vla_eval.config.policy import load_policy
from vla_eval.errors import CheckpointError, LockedError, RecipeError, UnknownNameError
from vla_eval.lock.switch import locked
from vla_eval.models.families import bases
from vla_eval.models.family import Base, Source
from vla_eval.policies.entries import load_policy_entries
from vla_eval.testing.tiny_models import tiny_paligemma

WEIGHTS_FILE = "model.safetensors"
BASE = Base(
    name="pi0_base",
    title="π0, tiny",
    terms="terms of the authors",
    parts=(
        Source(repo_id="somebody/words", revision=None, patterns=("tokenizer*",), folder="tokenizer"),
        Source(
            repo_id="somebody/pi0",
            revision=COMMIT,
            patterns=("config.json", WEIGHTS_FILE, "policy_p*"),
        ),
    ),
)


@pytest.fixture
def hub(pi0: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:  # noqa: F811
    words = tmp_path / "repositories" / "words"
    shutil.copytree(pi0 / "tokenizer", words)
    whole = shutil.copytree(pi0, tmp_path / "repositories" / "pi0", ignore=lambda *_: ["tokenizer"])
    (whole / "run_me.py").write_text("raise SystemExit('code of a checkpoint was run')\n")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(huggingface_hub.constants, "DOWNLOAD_CHUNK_SIZE", 1000)
    with serving(Hub({"somebody/words": words, "somebody/pi0": Path(whole)})) as served:
        yield served


def fetch(hub: Hub, out: Path, base: Base = BASE, **options: Any) -> list[str]:
    """Fetch, and return the lines for a person."""
    lines: list[str] = []
    with tiny_paligemma("pi0"):
        api = HfApi(endpoint=hub.endpoint, token=False)
        fetching.fetch_base(base, out, api=api, say=lines.append, **options)
    return lines


def test_a_base_is_complete_checked_and_says_where_it_came_from(
    hub: Hub,
    pi0: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    out = tmp_path / "checkpoints" / "pi0_base"
    lines = "\n".join(fetch(hub, out))
    assert COMMIT in lines and "apache-2.0" in lines and "terms of the authors" in lines
    assert "GB needed" in lines and "GB free" in lines
    n_tensors = len(load_file(pi0 / WEIGHTS_FILE))
    assert f"{n_tensors} tensors with the names and shapes of the network" in lines
    assert not (out / "run_me.py").exists() and not (out.parent / fetching.DOWNLOADS / "pi0_base").exists()
    noted = json.loads((out / BASE_FILE).read_text())
    assert [part["commit"] for part in noted["parts"]] == [COMMIT, COMMIT]
    with tiny_paligemma("pi0"):  # it acts, with the tokenizer that was fetched beside it
        verify_checkpoint(out, LoadOptions(device="cpu"))
    digest = checkpoint_sha256(out)
    (out / BASE_FILE).unlink()
    assert checkpoint_sha256(out) == digest  # a folder that was filled by hand is the same checkpoint


def test_a_base_that_is_there_is_checked_without_the_hub(hub: Hub, tmp_path: Path) -> None:
    out = tmp_path / "pi0_base"
    fetch(hub, out)
    hub.requests.clear()
    assert "is there" in fetch(hub, out)[0]
    assert hub.requests == []
    weights = load_file(out / WEIGHTS_FILE)
    weights.pop(next(iter(weights)))
    save_file(weights, out / WEIGHTS_FILE)
    with pytest.raises(CheckpointError, match="1 missing"):
        fetch(hub, out)


@pytest.fixture
def resnet_hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """Serve a ResNet-18 of few channels; the weights of torchvision's own are 47 MB."""
    monkeypatch.setattr(torchvision.models.resnet, "resnet18", thin_resnet)
    monkeypatch.setattr(torchvision.models, "resnet18", thin_resnet)
    repository = tmp_path / "timm"
    repository.mkdir()
    save_file(thin_resnet().state_dict(), repository / WEIGHTS_FILE)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    monkeypatch.chdir(tmp_path)
    with serving(Hub({bases()["resnet18"].weights.repo_id: repository})) as served:
        yield served


def thin_resnet(*, weights: Any = None) -> torch.nn.Module:
    network: Any = torchvision.models.ResNet(BasicBlock, [1, 1, 1, 1], num_classes=2, width_per_group=64)
    if weights is not None:
        network.load_state_dict(torchvision.models.ResNet18_Weights.verify(weights).get_state_dict())
    return network


def test_a_backbone_is_fetched_by_the_same_door_and_only_then_a_policy_starts_from_it(
    resnet_hub: Hub, tmp_path: Path
) -> None:
    weights = "ResNet18_Weights.IMAGENET1K_V1"
    with (
        fetched_backbones(),
        pytest.raises(
            CheckpointError,
            match=r"checkpoint fetch resnet18\. .*--set policy\.pretrained_backbone_weights=null",
        ),
    ):
        torchvision.models.resnet18(weights=weights)
    fetch(resnet_hub, Path("elsewhere"), bases()["resnet18"])  # the folder's name says nothing
    out = Path("checkpoints") / "resnet18"
    lines = fetch(resnet_hub, out, bases()["resnet18"])
    assert "names and shapes of torchvision's network" in lines[-1]
    published = load_file(tmp_path / "timm" / WEIGHTS_FILE)
    with fetched_backbones():
        made = torchvision.models.resnet18(weights=weights).state_dict()
    assert all(torch.equal(made[name], x) for name, x in published.items())
    published.pop("layer1.0.conv1.weight")
    save_file(published, out / WEIGHTS_FILE)
    with pytest.raises(CheckpointError, match=r"found others: layer1\.0\.conv1\.weight\."):
        fetch(resnet_hub, out, bases()["resnet18"])


def test_a_connection_that_is_cut_resumes_where_it_was(hub: Hub, tmp_path: Path) -> None:
    hub.cut_after_bytes[WEIGHTS_FILE], hub.n_cuts = 5000, 1
    fetch(hub, tmp_path / "pi0_base")
    first, second = hub.content_of(WEIGHTS_FILE)
    assert first is None
    assert second is not None and 0 < int(second.removeprefix("bytes=").rstrip("-")) <= 5000


def test_a_fetch_that_ended_early_leaves_no_folder_and_the_next_one_resumes(
    hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "pi0_base"
    hub.cut_after_bytes[WEIGHTS_FILE], hub.n_cuts = 5000, 1
    send = hub.content_of

    def refuse_after_the_cut(seconds: float) -> None:
        hub.refuses = bool(send(WEIGHTS_FILE))

    monkeypatch.setattr("time.sleep", refuse_after_the_cut)  # the client waits before it tries again
    with pytest.raises(CheckpointError) as caught:
        fetch(hub, out)
    assert "run the same command again to resume" in str(caught.value)
    assert not out.exists()
    monkeypatch.undo()
    hub.refuses = False
    hub.requests.clear()
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    fetch(hub, out)
    (resumed,) = hub.content_of(WEIGHTS_FILE)
    assert resumed is not None and int(resumed.removeprefix("bytes=").rstrip("-")) > 0
    with tiny_paligemma("pi0"):
        verify_checkpoint(out, LoadOptions(device="cpu"))


def test_a_disk_that_is_too_small_is_refused_before_anything_is_fetched(
    hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=fetching.MARGIN_BYTES)
    monkeypatch.setattr(fetching.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(CheckpointError, match="of free disk"):
        fetch(hub, tmp_path / "pi0_base")
    assert hub.requests == []


def test_content_that_is_not_what_the_hub_describes_is_removed(
    hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "pi0_base"
    monkeypatch.setattr(fetching, "file_sha256", lambda _: "0" * 64)
    with pytest.raises(CheckpointError, match="It was removed"):
        fetch(hub, out)
    assert not out.exists()
    assert not (tmp_path / fetching.DOWNLOADS / "pi0_base" / WEIGHTS_FILE).exists()


def test_terms_that_were_not_accepted_are_named(hub: Hub, tmp_path: Path) -> None:
    hub.gated.add("somebody/words")
    with pytest.raises(CheckpointError, match="accept") as caught:
        fetch(hub, tmp_path / "pi0_base")
    assert "terms of the authors" in str(caught.value) and "hf auth login" in str(caught.value)
    assert hub.content_of(WEIGHTS_FILE) == []  # the small part is asked for first


def test_without_a_network_the_error_names_the_folder_to_fill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    assert main(["checkpoint", "fetch", "pi0", "--out", str(tmp_path / "pi0_base")]) == 1
    message = capsys.readouterr().err
    revision = bases()["pi0_base"].weights.revision
    assert f"hf download lerobot/pi0_base --revision {revision}" in message
    assert f"--local-dir {tmp_path / 'pi0_base'}" in message
    assert main(["checkpoint", "fetch", "octo_small", "--out", str(tmp_path / "octo_small")]) == 1
    assert f"convert-octo {tmp_path / 'octo_small'}-original --size small" in capsys.readouterr().err


def test_a_sharded_checkpoint_is_converted(hub: Hub, tmp_path: Path) -> None:
    repository = tmp_path / "repositories" / "openvla"
    repository.mkdir()
    golden.write_published(repository)
    assert len(list(repository.glob("*.safetensors"))) == 2
    hub.repositories["somebody/openvla"] = repository
    source = Source(repo_id="somebody/openvla", revision=None, patterns=("*.json", "*.safetensors"))
    options = {**(bases()["openvla_7b"].options or {}), "sizes": golden.SMALL}
    base = dataclasses.replace(BASE, name="openvla_7b", parts=(source,), options=options)
    out = tmp_path / "openvla_7b"
    fetch(hub, out, base)
    assert find_checkpoint(out) == out and (out / BASE_FILE).is_file()
    assert not (tmp_path / fetching.DOWNLOADS / "openvla_7b").exists()


def test_every_shipped_recipe_with_a_base_has_a_command_that_fetches_it() -> None:
    started = set()
    for recipe in list_recipes("policies"):
        section = load_policy(recipe).value.finetune
        if section is not None and str(section.base_checkpoint).startswith("checkpoints/"):
            base = base_of_recipe(recipe)
            assert section.base_checkpoint == f"checkpoints/{base}"
            assert find_base(recipe) is bases()[str(base)]
            started.add(base)
    assert started == {name for name, base in bases().items() if not base.is_backbone}
    with pytest.raises(UnknownNameError, match="pi0_base"):
        find_base("pi0_bas")


def test_a_recipe_whose_base_is_missing_says_which_command_fetches_it(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="mikasa-vla checkpoint fetch pi0_base"):
        find_checkpoint(Path("checkpoints/pi0_base"))


def test_a_recipe_that_starts_from_another_training_says_which_command_trains_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where nobody has trained it
    first, then = (load_policy(name).value.finetune for name in ("recurrent_decisions", "recurrent_colors"))
    assert first is not None and then is not None and then.base_checkpoint == "runs/recurrent_decisions"
    with pytest.raises(
        CheckpointError,
        match="--policy recurrent_decisions --dataset DATASET --out runs/recurrent_decisions",
    ):
        find_checkpoint(Path(then.base_checkpoint))
    # The weights of the one fit the network of the other.
    for name in ("core", "core_options", "encoder", "erase_warmup_episodes"):
        assert then.policy[name] == first.policy[name], name


class TestHubIds:
    ID = f"hub:somebody/pi0@{COMMIT}"
    FOLDER = Path(f"checkpoints/somebody--pi0@{COMMIT}")
    EVAL = ("eval", "--task", "RememberColor3-v0", "--episodes", "1", "--set", "simulator=fake")

    @pytest.fixture
    def whole(self, hub: Hub, pi0: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hub:  # noqa: F811
        """Serve a whole LeRobot checkpoint where the Hub's client looks for the Hub."""
        shutil.copytree(pi0 / "tokenizer", hub.repositories["somebody/pi0"] / "tokenizer")
        monkeypatch.setattr(fetching, "HfApi", lambda: HfApi(endpoint=hub.endpoint, token=False))
        monkeypatch.chdir(tmp_path)
        return hub

    def test_a_policy_that_is_named_so_is_fetched_once_and_read_as_a_folder(self, whole: Hub) -> None:
        with tiny_paligemma("pi0"):
            (entry,) = load_policy_entries([f"mine={self.ID}"])
        asked = len(whole.requests)
        (again,) = load_policy_entries([f"mine={self.ID}"])

        assert entry == again and len(whole.requests) == asked
        assert entry.value.args == {"checkpoint": str(self.FOLDER)}
        assert entry.recipes[0].sha256 == checkpoint_sha256(self.FOLDER) == checkpoint_sha256(Path(self.ID))
        assert not (self.FOLDER / "run_me.py").exists()  # code is not fetched
        assert json.loads((self.FOLDER / BASE_FILE).read_text())["parts"][0]["commit"] == COMMIT

    def test_a_dry_run_fetches_nothing_and_names_the_command(
        self, whole: Hub, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main([*self.EVAL, "--policy", f"mine={self.ID}", "--dry-run"]) == 1
        assert f"mikasa-vla checkpoint fetch {self.ID}" in capsys.readouterr().err
        assert whole.requests == []

    def test_without_a_network_it_says_what_to_do(
        self, whole: Hub, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
        assert main([*self.EVAL, "--policy", self.ID]) == 1
        said = capsys.readouterr().err
        assert "HF_HUB_OFFLINE" in said and "Unset it" in said
        assert f"hf download somebody/pi0 --revision {COMMIT}" in said
        assert f"--local-dir {self.FOLDER}" in said

    def test_a_base_of_recipes_comes_with_its_tokenizer_and_its_pinned_commit(self) -> None:
        known = bases()["smolvla_base"]
        assert find_base("hub:lerobot/smolvla_base").parts == known.parts
        other = find_base("hub:lerobot/smolvla_base@main")
        assert (other.name, other.weights.revision) == ("lerobot--smolvla_base@main", "main")
        assert other.parts[:-1] == known.parts[:-1]

    @pytest.mark.parametrize(
        ("name", "message"),
        [
            ("hub:smolvla_base", r"expected hub:OWNER/NAME or hub:OWNER/NAME@REVISION"),
            ("hub:../../etc", r"expected hub:OWNER/NAME"),
            ("hub:a/b@../c", r"expected hub:OWNER/NAME"),
            ("hub:openvla/openvla-7b", r"expected a LeRobot checkpoint.*checkpoint fetch openvla_7b"),
        ],
    )
    def test_what_cannot_be_fetched_so_is_refused_before_anything_is_asked(
        self, name: str, message: str
    ) -> None:
        with pytest.raises((RecipeError, CheckpointError), match=message):
            load_policy_entries([name])

    def test_the_network_is_closed_again_afterwards(self, whole: Hub) -> None:
        with locked(), tiny_paligemma("pi0"):
            load_policy_entries([self.ID])
            with pytest.raises(LockedError):
                socket.create_connection(("127.0.0.1", int(whole.endpoint.rpartition(":")[2])))
