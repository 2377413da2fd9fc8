"""Which machines of a cluster are used, and what is said of the others; Ray is a stand-in."""

import dataclasses
import json
import socket
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vla_eval.errors import ClusterError, MissingDependencyError, RecipeError
from vla_eval.evaluation.needed_files import needed_files
from vla_eval.policies.entries import load_policy_entries
from vla_eval.workers import parcel as parcel_module
from vla_eval.workers.cluster import connect, machines
from vla_eval.workers.cluster.connect import check_address
from vla_eval.workers.cluster.machines import MAX_ERRORS_IN_A_ROW, Machines
from vla_eval.workers.cluster.node_facts import NodeFacts, node_facts, objections, receive
from vla_eval.workers.needed_files import Needed
from vla_eval.workers.parcel import PackedFolder, pack, unpack

HERE = NodeFacts(
    environment={
        "vla_eval": {"version": "1", "commit": "abc", "changes": None},
        "packages": {"torch": "2.8.0", "numpy": "2.2.1"},
        "python": "3.12.1",
        "platform": "Linux x86_64",
        "cpu": "A",
        "mesa": "25",
        "nvidia_driver": None,
    },
    vulkan=("lvp_icd.x86_64",),
    free_bytes=8 << 30,
    n_gpus=0,
)


def with_environment(**changes: Any) -> NodeFacts:
    return dataclasses.replace(HERE, environment={**HERE.environment, **changes})


class TestObjections:
    @pytest.mark.parametrize(
        ("found", "reason"),
        [
            (with_environment(packages={"torch": "2.7.1", "numpy": "2.2.1"}), 'packages.torch: "2.8.0" ->'),
            (with_environment(vla_eval={"version": "1", "commit": "d", "changes": None}), "vla_eval.commit"),
            (with_environment(cpu="B"), "another kind of machine"),
            (dataclasses.replace(HERE, vulkan=()), "no Vulkan driver"),
            (dataclasses.replace(HERE, free_bytes=1 << 29), "0.5 GB of memory are free"),
            (dataclasses.replace(HERE, missing=("data: it is not there",)), "data: it is not there"),
            (dataclasses.replace(HERE, recipes={"policies/act": "1" * 64}), "recipes.policies/act"),
        ],
    )
    def test_a_machine_that_would_give_other_results_is_refused(self, found: NodeFacts, reason: str) -> None:
        (objection,) = objections(found, HERE, allow_other_kind=False)
        assert reason in objection

    def test_another_kind_can_be_allowed_but_other_versions_cannot(self) -> None:
        assert objections(with_environment(cpu="B", mesa="26"), HERE, allow_other_kind=True) == ()
        assert objections(with_environment(python="3.13.0"), HERE, allow_other_kind=True)

    def test_kinds_have_the_same_name_if_they_are_the_same(self) -> None:
        assert with_environment(python="3.13.0").kind_name == HERE.kind_name
        assert with_environment(cpu="B").kind_name != HERE.kind_name


class TestNeededFiles:
    def test_a_file_must_be_there_with_its_digest(self, tmp_path: Path) -> None:
        file = tmp_path / "weights"
        need = Needed(path=str(file), sha256="right", digest=lambda path: path.read_text())
        assert "cannot be read" in (need.objection() or "")
        file.write_text("wrong")
        assert "another one" in (need.objection() or "")
        file.write_text("right")
        assert need.objection() is None

    def test_a_folder_must_be_there(self, tmp_path: Path) -> None:
        assert Needed(path=str(tmp_path)).objection() is None
        assert "is the storage shared?" in (Needed(path=str(tmp_path / "x")).objection() or "")


class TestParcels:
    def test_a_folder_is_written_whole_with_what_its_digest_needs(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        here, there = tmp_path / "here", tmp_path / "there"
        weights = here / "runs/x/checkpoints/last/pretrained_model/model.safetensors"
        weights.parent.mkdir(parents=True)
        weights.write_text("right")
        name = str(weights.parent.relative_to(here))
        need = Needed(
            path="runs/x",
            sha256="right",
            digest=lambda path: (path / "checkpoints/last/pretrained_model/model.safetensors").read_text(),
            folders=(name,),
        )
        monkeypatch.chdir(here)
        parcel = pack(name)

        there.mkdir()
        asked = node_facts((need,), folder=str(there))
        assert asked.absent == (name,) and len(asked.missing) == 1
        told = receive([parcel], (need,), folder=str(there))

        assert (told.absent, told.missing) == ((), ())
        assert (there / name / "model.safetensors").read_text() == "right"
        assert [path.name for path in (there / name).parent.iterdir()] == ["pretrained_model"]  # no draft

    def test_what_is_there_is_never_overwritten(self, tmp_path: Path) -> None:
        (tmp_path / "w").mkdir()
        (tmp_path / "w/file").write_text("theirs")
        unpack(PackedFolder(str(tmp_path / "w"), {"file": b"ours"}))
        assert (tmp_path / "w/file").read_text() == "theirs"

    def test_where_it_cannot_be_written_the_machine_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        need = Needed(path="w", sha256="s", digest=lambda path: path.read_text(), folders=("w",))
        told = receive([PackedFolder("w", {})], (need,), folder=str(tmp_path / "file"))
        assert "a checkpoint cannot be written there" in told.missing[-1]

    def test_large_ones_and_those_of_the_package_are_not_sent(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        folder = tmp_path / "weights"
        folder.mkdir()
        (folder / "config.json").write_text('{"type": "act"}')
        (folder / "model.safetensors").write_bytes(b"0" * 100)
        recipe = {"version": 1, "description": "d", "adapter": "lerobot", "default_n_action_steps": 4}
        (tmp_path / "own.yaml").write_text(json.dumps({**recipe, "args": {"checkpoint": str(folder)}}))
        policies = load_policy_entries((str(tmp_path / "own.yaml"), "memory_color3"))

        assert [need.folders for need in needed_files(policies)] == [(str(folder),), ()]
        monkeypatch.setattr(parcel_module, "MAX_PARCEL_BYTES", 100)
        assert [need.folders for need in needed_files(policies)] == [(), ()]


class StandIn:
    """Runs a task at once, where it is called."""

    exceptions = SimpleNamespace(RayError=ZeroDivisionError)

    def __init__(self, facts: dict[str, NodeFacts]) -> None:
        self.facts = facts
        self.n_cores = dict.fromkeys(facts, 2.0)
        self.gone: set[str] = set()
        self.sent: list[tuple[str, list[str]]] = []

    def nodes(self) -> list[dict[str, Any]]:
        return [
            {
                **{"NodeID": name, "Alive": name not in self.gone, "NodeManagerHostname": name},
                **{
                    "NodeManagerAddress": f"10.0.0.{index}",
                    "Resources": {"CPU": self.n_cores.get(name, 2.0)},
                },
            }
            for index, name in enumerate(self.facts)
        ]

    def remote(self, _task: Callable[..., Any]) -> Any:
        def options(*, scheduling_strategy: str, **_: Any) -> Any:
            return SimpleNamespace(remote=lambda *args, **_kwargs: self._call(scheduling_strategy, args))

        return SimpleNamespace(options=options)

    def _call(self, name: str, args: tuple[Any, ...]) -> str:
        if isinstance(args[0], list):  # folders are sent
            self.sent.append((name, [packed.path for packed in args[0]]))
            self.facts[name] = dataclasses.replace(self.facts[name], absent=())
        return name

    def wait(self, refs: list[str], **_: Any) -> tuple[list[str], list[str]]:
        return refs, []

    def get(self, ref: str) -> NodeFacts:
        return self.facts[ref]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Machines, StandIn, list[str]]]:
    monkeypatch.setattr(machines, "on_machine", lambda node: node)
    monkeypatch.setattr(machines, "node_facts", lambda: HERE)

    def make(**facts: NodeFacts) -> tuple[Machines, StandIn, list[str]]:
        lines: list[str] = []
        ray = StandIn(facts)
        return Machines(ray, say=lines.append), ray, lines

    return make


class TestMachines:
    def test_refused_ones_are_named_with_the_reason(self, cluster: Any) -> None:
        found, _, _ = cluster(good=HERE, old=with_environment(python="3.11.0"))
        found.survey()
        assert [machine.name.split("/")[0] for machine in found.usable] == ["good"]
        assert 'python: "3.12.1" -> "3.11.0"' in found.table()

    def test_a_machine_is_sent_once_what_it_does_not_have(self, cluster: Any, tmp_path: Path) -> None:
        adapter, base = tmp_path / "adapter", tmp_path / "base"
        for folder in (adapter, base):
            folder.mkdir()
            (folder / "file").write_bytes(b"0" * 1_500_000)
        found, ray, lines = cluster(a=HERE, b=dataclasses.replace(HERE, absent=(str(adapter), str(base))))
        found.survey()
        # The base first, so that an adapter that is there has its base.
        assert ray.sent == [("b", [str(base), str(adapter)])]
        assert "machine b" in lines[0] and lines[0].endswith("(3.0 MB)")
        assert [machine.node for machine in found.usable] == ["a", "b"]

    def test_without_a_usable_one_there_is_an_error_with_the_table(self, cluster: Any) -> None:
        found, _, _ = cluster(old=with_environment(python="3.11.0"))
        with pytest.raises(ClusterError, match=r"3\.11\.0"):
            found.survey()

    def test_one_that_errs_three_times_in_a_row_is_set_aside_and_named(self, cluster: Any) -> None:
        found, _, lines = cluster(good=HERE, bad=HERE)
        found.survey()
        good, bad = found
        for _ in range(MAX_ERRORS_IN_A_ROW - 1):
            found.note_error(bad, "no memory")
        found.note_answer(bad, n_items=1)
        found.note_error(bad, "no memory")
        assert bad.is_usable  # not in a row
        for _ in range(MAX_ERRORS_IN_A_ROW - 1):
            found.note_error(bad, "no memory")
        assert not bad.is_usable
        assert "bad" in lines[-1] and "no memory" in lines[-1]
        for _ in range(MAX_ERRORS_IN_A_ROW):
            found.note_error(good, "no memory")
        assert good.is_usable  # the last one

    def test_a_head_without_cores_does_not_count_as_another_machine(self, cluster: Any) -> None:
        found, ray, _ = cluster(head=HERE, only=HERE)
        ray.n_cores["head"] = 0.0
        found.survey()
        _, only = found
        for _ in range(MAX_ERRORS_IN_A_ROW):
            found.note_error(only, "no memory")
        assert only.is_usable

    def test_one_that_goes_is_named_and_one_that_comes_is_checked(self, cluster: Any) -> None:
        found, ray, lines = cluster(a=HERE, b=HERE)
        found.survey()
        ray.gone.add("a")
        ray.facts["c"] = HERE
        found.look(at_once=True)
        assert "machine a" in lines[-1] and "is gone" in lines[-1]
        assert [machine.node for machine in found.usable] == ["b", "c"]

    def test_progress_says_what_each_did_and_how_busy_its_gpus_are(
        self, cluster: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        clock = SimpleNamespace(seconds=100.0)
        monkeypatch.setattr(machines.time, "monotonic", lambda: clock.seconds)
        found, ray, _ = cluster(a=HERE, b=HERE)
        found.survey()
        a, b = found
        a.n_gpus, a.services = (
            2,
            [SimpleNamespace(busy_share=lambda share=share: share) for share in (0.4, 0.8)],
        )
        for machine in (a, b):  # the clock began with them
            machine.seen_at = 100.0
        a.n_used, clock.seconds = 1, 110.0
        found.note_answer(a, n_items=5)

        # 5 episodes in 10 seconds; of two servers, one is busy 40 % of the time and one 80 %.
        assert [line.split("/", 1)[1].split(": ", 1)[1] for line in found.progress().split("; ")] == [
            "1 worker, 5 done, 0.5 per second, GPU 60%",
            "0 workers, 0 done, 0 per second",
        ]
        ray.gone.add("b")
        found.look(at_once=True)
        assert [load.n_done for load in found.loads()] == [5]


class TestAddresses:
    @pytest.mark.parametrize("text", ["auto", "local", "ray://head:10001", "10.0.0.1:6379"])
    def test_these_are_clusters(self, text: str) -> None:
        assert check_address(text) == text

    @pytest.mark.parametrize("text", ["", "autos", "http://head:1", "ray://head"])
    def test_these_are_not(self, text: str) -> None:
        with pytest.raises(RecipeError, match="ray://HOST:PORT"):
            check_address(text)

    def test_where_nobody_listens_there_is_no_cluster(self) -> None:
        pytest.importorskip("ray", reason="the extra [cluster] is not installed")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{free.getsockname()[1]}"
        with pytest.raises(ClusterError, match="ray start"), connect.connected(address):
            pass

    def test_without_ray_the_message_says_how_to_install_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def missing(name: str) -> Any:
            raise ModuleNotFoundError(name, name=name)

        monkeypatch.setattr(connect.importlib, "import_module", missing)
        with pytest.raises(MissingDependencyError, match=r"mikasa-vla-eval\[cluster\]"):
            connect.load_ray()
