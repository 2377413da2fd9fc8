"""From training to evaluation: other sentences, cut ones, and tasks that become one, each said once."""

import contextlib
import dataclasses
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from tests.data.second_task import SENTENCE as TOUCH
from tests.data.second_task import TASK as SECOND
from tests.data.second_task import write_second_task
from tests.serving.served_policies import Running
from tests.training import tiny_trainings
from tests.training.tiny_trainings import SHORT, TASK, act, pi0
from vla_eval.checkpoints.files import FACTS_FILE, find_checkpoint, read_facts, write_facts
from vla_eval.cli.main import main
from vla_eval.config.finetuning import FinetuneConfig, HeldOutConfig
from vla_eval.data.dataset_folder import digest_files
from vla_eval.data.derived.mixing import mix_datasets
from vla_eval.data.facts import read_facts as read_manifest_facts
from vla_eval.data.manifest import RECORDING_FILE, write_entry
from vla_eval.errors import SpecMismatchError
from vla_eval.evaluation import evaluate as evaluate_module
from vla_eval.serving.host import HostOptions, host_policy
from vla_eval.serving.server import ServerOptions
from vla_eval.testing.tiny_models import TINY_RUNNER, tiny_paligemma
from vla_eval.training.dataset import training_dataset
from vla_eval.training.finetune import finetune

tokenizer = tiny_trainings.tokenizer

LOOK, FOLLOW = "look, wait, choose", "follow the ball"  # of the fixture `recorded`, in turn
FAKE = [
    *("--set", "simulator=fake", "--set", "env.horizon_steps=6", "--set", "env.delay_steps=0"),
    *("--workers", "2", "--episodes", "2"),
]
WORDS = {"width": 16, "heads": 2, "layers": 1, "context_steps": 20, "chunk_size": 3, "n_action_steps": 2}
HELD_OUT = HeldOutConfig(every_steps=2, episodes=1, simulator="fake")
OTHER, PERMUTED = "red before blue", "blue before red"


@pytest.fixture(autouse=True)
def cache_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def mixed(recorded: Path, tmp_path: Path) -> Path:
    mix_datasets([recorded, write_second_task(recorded)], tmp_path / "mixed")
    return tmp_path / "mixed"


@pytest.fixture
def prompts(tmp_path: Path) -> str:
    """Sentences that were never trained, and whose words are the same."""
    file = tmp_path / "permuted.yaml"
    file.write_text(
        f"version: 1\ndescription: d\nsource: s\ninstructions:\n  RememberColor: [{OTHER}]\n"
        f"  ShellGameTouch: [{PERMUTED}]\n"
    )
    return str(file)


def reads_words(dataset: Path, out: Path) -> FinetuneConfig:
    """A policy that reads which words a sentence has, and not their order."""
    return FinetuneConfig(
        policy="context_many",
        dataset=str(dataset),
        out=str(out),
        finetune={**SHORT, "steps": 2, "policy": WORDS},
        device="cpu",
        allow_unreplayed=True,
    )


@pytest.fixture
def trained(mixed: Path, tmp_path: Path) -> Path:
    finetune(reads_words(mixed, tmp_path / "words"))
    return tmp_path / "words"


@contextlib.contextmanager
def served(policy: Path) -> Iterator[Running]:
    server = Running(host_policy(HostOptions(policy=str(policy), max_batch=2)), ServerOptions(port=0))
    try:
        yield server
    finally:
        server.stop()
        server.wait()


def warned(lines: str) -> list[str]:
    """Return what each warning about a sentence is about, in order."""
    kinds = {"was never trained with": "other", "one and the same of two tasks": "same", " tokens of ": "cut"}
    return [
        kind
        for line in lines.splitlines()
        for said, kind in kinds.items()
        if line.startswith("warning: policy") and said in line
    ]


class TestFacts:
    def test_the_sentences_of_each_task_are_noted_as_training_reads_them(self, trained: Path) -> None:
        facts = read_facts(find_checkpoint(trained))
        assert facts is not None
        assert facts.sentences == {TASK: (LOOK, FOLLOW), SECOND: (TOUCH,)}
        assert facts.gripper_open == 1.0

    def test_those_of_episodes_that_are_left_out_are_not(self, mixed: Path) -> None:
        dataset = training_dataset(mixed, allow_unreplayed=True)
        assert dataset.sentences == {TASK: (LOOK, FOLLOW), SECOND: (TOUCH,)}
        assert dataclasses.replace(dataset, left_out=(4, 5)).sentences == {TASK: (LOOK, FOLLOW)}
        assert dataclasses.replace(dataset, left_out=(1, 3)).sentences == {TASK: (LOOK,), SECOND: (TOUCH,)}
        assert dataclasses.replace(dataset, left_out=(0, 1)).sentences == dataset.sentences


class TestOtherSentences:
    @pytest.mark.usefixtures("small_act")
    def test_check_and_a_dry_run_name_both_sentences_once(
        self, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        finetune(act(recorded, tmp_path / "run"))
        assert main(["check", str(tmp_path / "run")]) == 0
        error = capsys.readouterr().err
        assert warned(error) == ["other"] and LOOK in error and "Remember the color" in error
        assert main(["eval", "--policy", str(tmp_path / "run"), "--task", TASK, *FAKE, "--dry-run"]) == 0
        assert warned(capsys.readouterr().out) == ["other"]

    @pytest.mark.usefixtures("small_act")
    def test_a_checkpoint_without_the_facts_loads_and_says_so(
        self, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        finetune(act(recorded, tmp_path / "run"))
        folder = find_checkpoint(tmp_path / "run")
        facts = read_facts(folder)
        assert facts is not None
        write_facts(folder, dataclasses.replace(facts, sentences=None, gripper_open=None))
        for _ in range(2):
            assert main(["check", str(tmp_path / "run")]) == 0
            (note,) = capsys.readouterr().err.splitlines()
            assert note.startswith("note: policy 'run-000004': with which sentences it was trained is not")
            (folder / FACTS_FILE).unlink(missing_ok=True)  # then as another program's

    def test_an_evaluation_before_the_training_names_what_its_checkpoints_will_be_asked(
        self, recorded: Path, tmp_path: Path
    ) -> None:
        config = dataclasses.replace(act(recorded, tmp_path / "run"), held_out=HELD_OUT)
        lines: list[str] = []
        with pytest.raises(StopIteration):
            finetune(config, say=raising(lines))
        (line,) = [line for line in lines if line.startswith("warning: policy")]
        assert "policy 'act' is asked on RememberColor3-v0 with a sentence that it was never trained" in line

    @pytest.mark.parametrize("change", [{"image_size": 64}, {"control_mode": "pd_joint_pos"}])
    def test_an_evaluation_that_every_checkpoint_would_refuse_is_refused_before_the_training(
        self, recorded: Path, tmp_path: Path, change: dict[str, Any]
    ) -> None:
        held_out = dataclasses.replace(HELD_OUT, env=change)
        with pytest.raises(Exception, match=r"expected .*128|held_out.env.control_mode: expected"):
            finetune(dataclasses.replace(act(recorded, tmp_path / "run"), held_out=held_out))
        assert not (tmp_path / "run").exists()

    def test_another_frame_rate_is_named_before_the_training(self, recorded: Path, tmp_path: Path) -> None:
        at_10_hz(recorded)
        facts = dataclasses.replace(read_manifest_facts(recorded), files=digest_files(recorded))
        write_entry(recorded / RECORDING_FILE, facts)
        dataset = training_dataset(recorded, allow_unreplayed=True)
        assert dataset.meta.fps == 10
        lines: list[str] = []
        with pytest.raises(StopIteration):
            finetune(act(recorded, tmp_path / "run"), say=raising(lines))
        (line,) = [line for line in lines if line.startswith("warning:")]
        assert "every evaluation would refuse this policy: control steps per second: expected 10.0" in line
        with pytest.raises(SpecMismatchError, match=r"control steps per second: expected 10\.0, found 20\.0"):
            finetune(dataclasses.replace(act(recorded, tmp_path / "run"), held_out=HELD_OUT))


def at_10_hz(root: Path) -> None:
    """Let all tables of a dataset of 20 frames per second say 10."""
    info = root / "meta/info.json"
    info.write_text(info.read_text().replace('"fps": 20', '"fps": 10'))
    for path in (*root.glob("data/*/*.parquet"), *root.glob("meta/episodes/*/*.parquet")):
        table = pd.read_parquet(path)
        times = [
            name for name in table if name == "timestamp" or name.endswith(("from_timestamp", "to_timestamp"))
        ]
        table[times] *= 2
        table.to_parquet(path)


def raising(lines: list[str]) -> Any:
    """Collect lines, and end the call where the training itself would begin."""

    def say(line: str) -> None:
        lines.append(line)
        if line.startswith("run: "):
            raise StopIteration

    return say


class TestOneSentence:
    @pytest.mark.sampled(2)
    @pytest.mark.parametrize("inference", ["in_process", "shared"])
    def test_an_evaluation_says_each_once_wherever_the_policy_is(
        self, inference: str, trained: Path, prompts: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        tasks = ["--task", TASK, SECOND, "--set", f"prompt_set={prompts}", "--set", f"inference={inference}"]
        arguments = ["eval", "--policy", str(trained), *tasks, *FAKE, "--out", str(tmp_path / "out")]
        assert main(arguments) == 0
        error = capsys.readouterr().err
        assert warned(error) == ["other", "other", "same"]
        assert f"'{OTHER}' ({TASK})" in error and f"'{PERMUTED}' ({SECOND})" in error
        assert main([*arguments, "--episodes", "3"]) == 0  # resumed: the workers find it again
        capsys.readouterr()
        assert main(["report", str(tmp_path / "out")]) == 0
        assert capsys.readouterr().out.count("reads one and the same of two tasks") == 1

    def test_a_server_says_it_to_its_log_and_to_an_evaluation(
        self,
        trained: Path,
        prompts: str,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        with caplog.at_level(logging.WARNING, "vla_eval.serving"), served(trained) as server:
            tasks = ["--task", TASK, SECOND, "--set", f"prompt_set={prompts}"]
            arguments = ["eval", "--policy", server.url, *tasks, *FAKE, "--out", str(tmp_path / "out")]
            assert main(arguments) == 0
        assert warned(capsys.readouterr().err) == ["other", "other", "same"]
        logged = [f"warning: {r.getMessage()}" for r in caplog.records if "asked_sentences" in r.name]
        assert sorted(warned("\n".join(logged))) == ["other", "other", "same"]

    def test_check_says_nothing_of_a_sentence_that_was_trained(
        self, trained: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
    ) -> None:
        file = tmp_path / "trained.yaml"
        file.write_text(
            f"version: 1\ndescription: d\nsource: s\ninstructions:\n  RememberColor: ['{LOOK}']\n"
            f"  ShellGameTouch: ['{TOUCH}']\n"
        )
        tasks = ["--task", TASK, SECOND, "--set", f"prompt_set={file}"]
        arguments = ["eval", "--policy", str(trained), *tasks, *FAKE, "--out", str(tmp_path / "out")]
        assert main(arguments) == 0
        assert warned(capsys.readouterr().err) == []


class TestCutSentences:
    @pytest.mark.slow
    def test_training_check_and_evaluation_name_what_a_tokenizer_cuts_once(
        self,
        recorded: Path,
        tokenizer: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        data = recorded.parent / "mixed"
        mix_datasets([recorded, write_second_task(recorded, sentence="look and touch")], data)
        config = pi0(data, tmp_path / "run", tokenizer)
        policy = {**config.finetune["policy"], "tokenizer_max_length": 1}  # a sentence's first letters
        config = dataclasses.replace(
            config,
            finetune={**config.finetune, "policy": policy, "batch_size": 16},
            held_out=dataclasses.replace(
                HELD_OUT, env={"horizon_steps": 6, "delay_steps": 0}, workers=1, task=TASK
            ),
        )
        monkeypatch.setattr(evaluate_module, "RUNNER", TINY_RUNNER)
        lines: list[str] = []
        with tiny_paligemma("pi0"):
            finetune(config, say=lines.append)
            # Three sentences in training; that of the evaluation once for both checkpoints.
            assert sorted(warned("\n".join(lines))) == ["cut", "cut", "cut", "cut", "other", "same"]
            assert sum("held-out seeds" in line for line in lines) == 2
            assert main(["check", str(tmp_path / "run")]) == 0
        assert warned(capsys.readouterr().err) == ["other", "cut"]
        arguments = ["eval", "--policy", str(tmp_path / "run"), "--task", TASK, *FAKE]
        assert main([*arguments, "--out", str(tmp_path / "out")]) == 0
        assert warned(capsys.readouterr().err) == ["other", "cut"]
