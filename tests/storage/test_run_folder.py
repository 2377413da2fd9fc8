"""The run folder: one writer, resumed only as what it was, and never somebody else's folder."""

import os
import subprocess
import sys
from pathlib import Path
from types import MappingProxyType

import pytest

from tests.storage.run_records import describe, result, writer
from vla_eval.errors import RunChangedError, RunFolderError
from vla_eval.records import EpisodeTiming
from vla_eval.storage.run_folder import RunFolder, StoredEpisode, read_run
from vla_eval.storage.timings import read_timings

# ------------------------------------------------------------------------------- one writer


def test_a_second_process_is_told_who_is_writing(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe(config={}, environment={}, recipes={})):
        second = subprocess.run(writer(tmp_path / "r", 1), capture_output=True, text=True, check=False)
    assert second.returncode == 1
    assert f"another process (pid {os.getpid()}) is writing" in second.stderr


def test_a_run_that_goes_on_can_be_read(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(1))
        assert read_run(tmp_path / "r").records == (result(1),)


def test_reading_writes_nothing(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.append(result(1))
    with (tmp_path / "r/episodes.jsonl").open("a") as file:
        file.write("{torn")
    before = {path.name: path.read_bytes() for path in (tmp_path / "r").iterdir()}
    read_run(tmp_path / "r")
    assert {path.name: path.read_bytes() for path in (tmp_path / "r").iterdir()} == before


# ------------------------------------------------------------------------------- resume


def test_a_changed_configuration_is_refused_value_by_value(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()):
        pass
    changed = describe(
        config={"episodes": 40, "tasks": ["B"], "env": {"delay_steps": 5}},
        recipes={"policies/oracle": "bb"},
    )
    with pytest.raises(RunChangedError) as caught:
        RunFolder.open(tmp_path / "r", changed, allow_environment_change=True)
    message = str(caught.value)
    assert "config.episodes: 50 -> 40" in message
    assert 'config.tasks: ["A"] -> ["B"]' in message
    assert "config.env.delay_steps: (not set) -> 5" in message
    assert 'recipes.policies/oracle: "aa" -> "bb"' in message


def test_a_refused_change_names_the_command_that_puts_it_beside(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()):
        pass
    (tmp_path / "r-2").mkdir()
    command = f"mikasa-vla eval demo --episodes 40 --out {tmp_path / 'r'} --workers 1"
    fewer = describe(config={"episodes": 40, "tasks": ["A"], "env": {}}, command=command)

    with pytest.raises(RunChangedError) as caught:
        RunFolder.open(tmp_path / "r", fewer)

    beside = f"mikasa-vla eval demo --episodes 40 --workers 1 --out {tmp_path / 'r-3'}"
    assert str(caught.value).splitlines()[-1].strip() == beside


MORE: dict[str, object] = {
    "episodes": 60,
    "runs": 2,
    "tasks": ["B", "A"],
    "policies": ["oracle", "random"],
    "policy_names": ["oracle", "random"],
    "n_action_steps": [1, 4],
    "task_versions": {"A": 1, "B": 3},
}


@pytest.mark.parametrize("field", MORE)
def test_a_run_may_grow_in_each_list_and_number_of_its_plan_but_not_shrink(
    tmp_path: Path, field: str
) -> None:
    small: dict[str, object] = {
        "episodes": 50,
        "runs": 1,
        "tasks": ["A"],
        "policies": ["oracle"],
        "policy_names": ["oracle"],
        "n_action_steps": [4],
        "task_versions": {"A": 1},
    }
    large = small | {field: MORE[field]}
    with RunFolder.open(tmp_path / "r", describe(config=small)):
        pass

    with RunFolder.open(tmp_path / "r", describe(config=large, command="more")):
        pass

    stored = read_run(tmp_path / "r")
    assert stored.description.config == large
    assert stored.description.command == "more"
    assert [change.path for change in stored.sessions[-1].plan_changes] == [
        f"config.{field}.B" if field == "task_versions" else f"config.{field}"
    ]
    with pytest.raises(RunChangedError, match=field):
        RunFolder.open(tmp_path / "r", describe(config=small))


def test_a_checkpoint_may_be_added_to_a_policy_of_several_but_none_replaced(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe(config={"policies": ["m=runs/a,runs/b"]})):
        pass
    with pytest.raises(RunChangedError, match=r"config\.policies"):
        RunFolder.open(tmp_path / "r", describe(config={"policies": ["m=runs/a,runs/c,runs/b"]}))
    with RunFolder.open(tmp_path / "r", describe(config={"policies": ["m=runs/a,runs/b,runs/c"]})):
        pass


def test_a_run_grows_by_a_policy_with_its_recipe_while_those_it_has_stay(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe(servers={"remote": {"model": "a"}})):
        pass
    recipes = {"policies/oracle": "aa", "policies/random": "cc"}
    servers = {"remote": {"model": "a"}, "other": {"model": "b"}}
    with RunFolder.open(tmp_path / "r", describe(recipes=recipes, servers=servers)):
        pass
    assert read_run(tmp_path / "r").description.recipes == {"policies/oracle": "aa"}
    more = {"episodes": 50, "tasks": ["A", "B"], "env": {}}
    with RunFolder.open(tmp_path / "r", describe(config=more, recipes=recipes, servers=servers)):
        pass
    stored = read_run(tmp_path / "r").description
    assert (stored.recipes, stored.servers) == (recipes, servers)
    for changed in (
        describe(config=more, recipes={**recipes, "policies/oracle": "bb"}, servers=servers),
        describe(config=more, recipes=recipes, servers={**servers, "remote": {"model": "a", "step": 2}}),
    ):
        with pytest.raises(RunChangedError):
            RunFolder.open(tmp_path / "r", changed)


def test_options_and_command_may_change(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()):
        pass
    with RunFolder.open(tmp_path / "r", describe(options={"workers": 8}, command="other")):
        pass
    stored = read_run(tmp_path / "r")
    assert [session.options for session in stored.sessions] == [{"workers": 2}, {"workers": 8}]
    assert [session.command for session in stored.sessions] == ["mikasa-vla eval demo", "other"]


def test_a_tuple_is_no_change_against_the_list_that_it_became(tmp_path: Path) -> None:
    description = describe(config={"tasks": ("A", "B")})
    with RunFolder.open(tmp_path / "r", description):
        pass
    with RunFolder.open(tmp_path / "r", description):
        pass


def test_read_only_mappings_can_be_stored(tmp_path: Path) -> None:
    frozen = MappingProxyType({"env": MappingProxyType({"delay_steps": 5})})
    with RunFolder.open(tmp_path / "r", describe(config=frozen)):
        pass
    with RunFolder.open(tmp_path / "r", describe(config=frozen)):
        pass
    assert read_run(tmp_path / "r").description.config == {"env": {"delay_steps": 5}}


def test_a_changed_environment_is_refused_unless_allowed_and_then_recorded(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()):
        pass
    changed = describe(environment={"commit": "c2"})
    with pytest.raises(
        RunChangedError, match=r'environment\.commit: "c1" -> "c2"(.|\n)*--allow-environment-ch'
    ):
        RunFolder.open(tmp_path / "r", changed)
    with RunFolder.open(tmp_path / "r", changed, allow_environment_change=True):
        pass
    first, second = read_run(tmp_path / "r").sessions
    assert first.environment_changes == ()
    assert [str(change) for change in second.environment_changes] == ['environment.commit: "c1" -> "c2"']


def test_the_device_is_recorded_once_a_worker_knows_it(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.note_device({"physics": "cpu"})
        folder.note_device({"physics": "cpu", "gpu": "H200"})
    assert read_run(tmp_path / "r").description.environment == {
        "commit": "c1",
        "device": {"physics": "cpu", "gpu": "H200"},
    }


def test_another_device_is_an_environment_change(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.note_device({"physics": "cpu", "gpu": "H200"})
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        folder.note_device({"physics": "cpu"})  # less is known: no contradiction
        with pytest.raises(RunChangedError, match=r'environment\.device\.gpu: "H200" -> "A100"'):
            folder.note_device({"physics": "cpu", "gpu": "A100"})
    with RunFolder.open(tmp_path / "r", describe(), allow_environment_change=True) as folder:
        folder.note_device({"gpu": "A100"})
        folder.note_device({"gpu": "A100"})
    stored = read_run(tmp_path / "r")
    assert stored.description.environment["device"] == {"physics": "cpu", "gpu": "H200"}
    assert [str(c) for c in stored.sessions[-1].environment_changes] == [
        'environment.device.gpu: "H200" -> "A100"'
    ]


# ------------------------------------------------------------------------------- wrong folders


def test_a_strangers_folder_is_not_written_into(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/chapter.tex").write_text("…")
    with pytest.raises(RunFolderError, match=r"thesis: holds other files \(chapter\.tex\) and no run\.json"):
        RunFolder.open(tmp_path / "thesis", describe())
    assert os.listdir(tmp_path / "thesis") == ["chapter.tex"]


def test_episodes_without_their_description_are_not_continued(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "r", describe()):
        pass
    (tmp_path / "r/run.json").unlink()
    with pytest.raises(RunFolderError, match=r"holds episodes\.jsonl but no run\.json"):
        RunFolder.open(tmp_path / "r", describe())


def test_a_file_in_the_place_of_the_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "r").write_text("")
    with pytest.raises(RunFolderError, match="expected a folder, found a file"):
        RunFolder.open(tmp_path / "r", describe())


@pytest.mark.parametrize("content", ["{", "[]", '{"format_version": 1}', '{"format_version": 1, "x": 2}'])
def test_a_damaged_run_json_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "r").mkdir()
    (tmp_path / "r/run.json").write_text(content)
    with pytest.raises(RunFolderError, match=r"run\.json: expected the description of a run"):
        read_run(tmp_path / "r")


def test_a_run_folder_of_another_version_is_refused(tmp_path: Path) -> None:
    (tmp_path / "r").mkdir()
    (tmp_path / "r/run.json").write_text('{"format_version": 2}')
    with pytest.raises(RunFolderError, match="format version 2, this program reads version 1"):
        read_run(tmp_path / "r")


def test_a_mistyped_run_folder_gets_a_suggestion(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "demo-1a2b", describe()):
        pass
    with pytest.raises(RunFolderError, match=r"does not exist\. Did you mean 'demo-1a2b'\?"):
        read_run(tmp_path / "demo-1a2c")


def test_the_folder_of_run_folders_is_recognised(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "demo", describe()):
        pass
    with pytest.raises(RunFolderError, match=r"is not a run folder, but holds some\. Name them: .*demo"):
        read_run(tmp_path)


@pytest.mark.parametrize(
    ("file", "kind"),
    [
        ("meta/info.json", "dataset"),
        ("finetune.json", "training"),
        ("config.json", "checkpoint"),
        ("recording.lock", "recording's state"),
    ],
)
def test_a_folder_of_another_kind_is_named_and_never_offered_as_a_run(
    file: str, kind: str, tmp_path: Path
) -> None:
    folder = tmp_path / "out" / "one"
    (folder / file).parent.mkdir(parents=True)
    for name in ("run.json", file) if file == "recording.lock" else (file,):
        (folder / name).write_text("{}")
    with pytest.raises(RunFolderError, match=f"one: is a {kind}.*, not a run folder"):
        read_run(folder)
    with pytest.raises(RunFolderError) as found:
        read_run(tmp_path)
    assert "holds some" not in str(found.value)
    assert (f"Below it are {kind}s: {folder}." in str(found.value)) == (file != "recording.lock")


def test_store_and_records_import_nothing_heavy() -> None:
    code = (
        "import sys, vla_eval.storage.run_folder, vla_eval.records\n"
        "heavy = ('torch', 'sapien', 'mani_skill', 'lerobot', 'cv2', 'rerun', 'scipy', 'pandas')\n"
        "print([name for name in heavy if name in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert output.stdout.strip() == "[]"


class TestMachinesOfAnotherKind:
    """A cluster's machines may differ; the run then says so, as if it had been resumed on another machine."""

    def test_they_are_refused_unless_changes_are_allowed(self, tmp_path: Path) -> None:
        description = describe(environment={"cpu": "A"})
        with RunFolder.open(tmp_path / "r", description) as folder:
            folder.note_machine("k1", {"cpu": "A"})  # the same
            with pytest.raises(RunChangedError, match="cpu"):
                folder.note_machine("k2", {"cpu": "B"})

    def test_the_run_names_them_and_each_timing_its_kind(self, tmp_path: Path) -> None:
        description = describe(environment={"cpu": "A"})
        with RunFolder.open(tmp_path / "r", description, allow_environment_change=True) as folder:
            folder.note_machine("k2", {"cpu": "B"})
            folder.append(result(1), timing(1, kind="k2"))
            folder.append(result(2), timing(2, kind=None))
        (session,) = read_run(tmp_path / "r").sessions
        assert [(c.old, c.new) for c in session.environment_changes] == [('"A"', '"B"')]
        kinds = {key.seed: one.kind for key, one in read_timings(tmp_path / "r").items()}
        assert kinds == {1: "k2", 2: None}
        assert '"kind"' not in (tmp_path / "r" / "timings.jsonl").read_text().splitlines()[1]


def timing(seed: int, *, kind: str | None) -> EpisodeTiming:
    seconds = {f"{name}_seconds": 1.0 for name in ("total", "reset", "step", "inference")}
    return EpisodeTiming(key=result(seed).key, kind=kind, **seconds)


def test_several_episodes_are_durable_at_once_and_one_that_is_wrong_does_not_cost_those_before_it(
    tmp_path: Path,
) -> None:
    with RunFolder.open(tmp_path / "r", describe()) as folder:
        with pytest.raises(RunFolderError, match="counted twice"):
            folder.append_all([StoredEpisode(result(seed), None) for seed in (1, 2, 2, 3)])
        assert {key.seed for key in folder.finished_keys()} == {1, 2}
    assert {record.seed for record in read_run(tmp_path / "r").records} == {1, 2}
