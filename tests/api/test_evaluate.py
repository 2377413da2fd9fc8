"""`vla_eval.evaluate` from scripts and notebooks: the same records as the verb, for names and for objects."""

import random
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest

import vla_eval
from vla_eval.api.evaluating import entries_of
from vla_eval.cli.main import main
from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.errors import RecipeError, VlaEvalError
from vla_eval.policies.given import identity_of
from vla_eval.specs import PolicySpec
from vla_eval.storage.run_folder import read_run

TASK = "RememberColor3-v0"
cloudpickle.register_pickle_by_value(sys.modules[__name__])  # as of a notebook: no worker can import it
FAST: dict[str, Any] = {"simulator": "fake", "episodes": 3, "workers": 1}


class Still:
    """Holds still."""

    def __init__(self, name: str = "still", height: float = 0.0) -> None:
        self.spec = PolicySpec(name=name, reads="last", cameras=(), states=(), chunk_size=4)
        self.height = height

    def reset(self, episodes: list[EpisodeStart]) -> None:
        pass

    def act(self, window: ObservationWindow) -> ActionChunk:
        actions = np.zeros((4, 7), dtype=np.float32)
        actions[:, 2] = self.height
        return ActionChunk(actions=actions)


def digests(run: vla_eval.Run) -> list[str | None]:
    return [record.trajectory_sha256 for record in run.records]


def test_names_give_the_records_of_the_verb(tmp_path: Path) -> None:
    out = tmp_path / "verb"
    verb = [
        "eval",
        "--task",
        TASK,
        "--policy",
        "oracle",
        "hold",
        "--episodes",
        "3",
        "--n-action-steps",
        "1",
        "4",
    ]
    assert main([*verb, "--set", "simulator=fake", "--out", str(out)]) == 0
    run = vla_eval.evaluate(
        policy=["oracle", "hold"], tasks=TASK, n_action_steps=[1, 4], out=tmp_path / "run", **FAST
    )
    assert sorted(run.records, key=repr) == sorted(read_run(out).records, key=repr)


MAKERS = [Still(), Still, lambda: Still(), lambda context: Still(context.name)]


@pytest.mark.parametrize("policy", MAKERS, ids=["instance", "class", "function", "function of a context"])
def test_an_instance_a_class_and_a_function_give_the_same_episodes(policy: Any, tmp_path: Path) -> None:
    run = vla_eval.evaluate(policy={"mine": policy}, tasks=TASK, out=tmp_path / "run", **FAST)
    assert [record.policy for record in run.records] == ["mine"] * 3
    held = vla_eval.evaluate(
        policy={"mine": Still()}, tasks=TASK, in_process=True, out=tmp_path / "here", **FAST
    )
    assert run.records == held.records


def test_in_this_process_global_generators_stay_as_they_were(tmp_path: Path) -> None:
    random.seed(3)  # noqa: TID251
    np.random.seed(3)  # noqa: TID251
    expected = random.random(), np.random.random()  # noqa: TID251
    random.seed(3)  # noqa: TID251
    np.random.seed(3)  # noqa: TID251
    vla_eval.evaluate(policy=Still(), tasks=TASK, in_process=True, out=tmp_path / "run", **FAST)
    assert (random.random(), np.random.random()) == expected  # noqa: TID251


def test_the_same_call_resumes_and_another_version_of_the_policy_gets_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    first = vla_eval.evaluate(policy=Still(), tasks=TASK, in_process=True, **FAST)
    again = vla_eval.evaluate(policy=Still(), tasks=TASK, in_process=True, **FAST)
    other = vla_eval.evaluate(policy=Still(height=0.1), tasks=TASK, in_process=True, **FAST)
    assert first.path == again.path != other.path
    assert len(first.stored[0].sessions) == len(again.stored[0].sessions) - 1
    with pytest.raises(VlaEvalError, match="policies/still"):
        vla_eval.evaluate(policy=Still(height=0.2), tasks=TASK, out=first.path, in_process=True, **FAST)


CELLS = """
LIMIT = {limit}
class Mine:
    def act(self, window):
        return LIMIT, {{"a", "b", "c"}} == window
"""
IDENTITY = """
import sys
from vla_eval.policies.given import identity_of
exec(compile(sys.argv[1], sys.argv[2], "exec"))
print(identity_of(Mine()))
"""


def identity_elsewhere(code: str, file_name: str) -> str:
    """Return the digest of the class of a cell, in a process with another hash seed."""
    command = [sys.executable, "-c", IDENTITY, code, file_name]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_the_same_cell_is_the_same_policy_in_another_kernel_and_what_it_uses_counts() -> None:
    first = identity_elsewhere(CELLS.format(limit=1), "ipykernel_1/1.py")
    assert first == identity_elsewhere("\n\n" + CELLS.format(limit=1), "ipykernel_2/7.py")
    assert first != identity_elsewhere(CELLS.format(limit=2), "ipykernel_1/1.py")
    assert first != identity_elsewhere(CELLS.format(limit=1).replace("==", "!="), "ipykernel_1/1.py")


def test_an_attribute_changes_the_identity_of_an_instance() -> None:
    assert identity_of(Still()) == identity_of(Still()) != identity_of(Still(height=0.1))


SCRIPT = """
import numpy as np
import vla_eval
from vla_eval.core import ActionChunk
from vla_eval.specs import PolicySpec

class Mine:
    def __init__(self):
        self.spec = PolicySpec(name="mine", reads="last", cameras=(), states=(), chunk_size=1)
    def reset(self, episodes):
        pass
    def act(self, window):
        return ActionChunk(actions=np.zeros((1, 7), dtype=np.float32))

run = vla_eval.evaluate(
    policy=[Mine, "oracle"], tasks="RememberColor3-v0", simulator="fake", episodes=2, workers=2, out="out"
)
print(run)
"""


def test_a_class_of_a_script_without_a_main_guard_is_evaluated_in_workers(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert (done.returncode, done.stdout) == (0, "<Run out: 4 episodes>\n"), done.stderr


class Unpicklable(Still):
    """Holds what no other process can have."""

    def __init__(self) -> None:
        super().__init__()
        self.lock = threading.Lock()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"policy": 3}, "has no spec, reset, act"),
        ({"policy": [Still(), object()]}, "has no spec, reset, act"),
        ({"policy": lambda: Still()}, "a lambda has no name"),
        ({"policy": Unpicklable()}, "cannot .*pickle.*Give the class"),
        ({"policy": {"a/b": Still()}}, "a/b"),
        ({"policy": {"cue_blind": Still()}}, "my_cue_blind"),
        ({"policy": Still("oracle")}, "my_oracle"),
        ({"policy": "oracel"}, "oracle"),
        ({"policy": "oracle", "tasks": "RememberColour3-v0"}, "RememberColor3-v0"),
        ({"policy": "oracle", "episode": 3}, "episodes"),
        ({"policy": "oracle", "episodes": "3"}, "episodes"),
        ({"policy": None}, "`policy` is missing"),
        ({"policy": "oracle", "tasks": None}, "`tasks` is missing"),
        ({"policy": "oracle", "protocol": "leaderboard_mikas"}, "leaderboard_mikasa"),
    ],
    ids=lambda value: str(value)[:30] if isinstance(value, str) else None,
)
def test_a_mistake_is_answered_with_what_was_expected(given: Any, said: str, tmp_path: Path) -> None:
    settings = {"tasks": TASK, "out": tmp_path / "run", "simulator": "fake", **given}
    with pytest.raises(VlaEvalError, match=said):
        vla_eval.evaluate(**settings)
    assert not (tmp_path / "run").exists()


class Returns:
    """A factory whose product is no policy."""

    def __new__(cls) -> Any:
        return 7


def test_a_class_that_makes_no_policy_is_refused_by_the_first_worker(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="found 7, which has no spec"):
        vla_eval.evaluate(policy=Returns, tasks=TASK, out=tmp_path / "run", in_process=True, **FAST)


def test_check_policy_takes_objects_and_names() -> None:
    assert vla_eval.check_policy("hold")
    assert vla_eval.check_policy(Still)


def test_the_page_on_python_works_as_a_script(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
    defined, read, *_ = (block.partition("```")[0] for block in page.split("```python\n")[1:])
    small = defined.replace("episodes=20", 'episodes=2, simulator="fake", out="runs/mine"')
    (tmp_path / "script.py").write_text(f"{small}\n{read}\nprint(len(run.to_pandas('episodes')))", "utf-8")
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "18"  # three policies, three K, two episodes
    assert (tmp_path / "runs" / "mine-report" / "index.html").is_file()


class Raises(Still):
    """Divides by zero at the third control step."""

    def act(self, window: ObservationWindow) -> ActionChunk:
        1 / (2 - window.last.step)
        return super().act(window)


@pytest.mark.parametrize("in_process", [False, True])
def test_an_exception_names_the_line_of_the_policy_and_the_step(in_process: bool, tmp_path: Path) -> None:
    lines = Path(__file__).read_text(encoding="utf-8").splitlines()
    number = next(i for i, line in enumerate(lines, start=1) if line.strip().startswith("1 / (2 -"))
    run = vla_eval.evaluate(policy=Raises, tasks=TASK, out=tmp_path / "run", in_process=in_process, **FAST)
    said = f"division by zero (test_evaluate.py, line {number}, at control step 2)"
    assert [record.error and record.error.message for record in run.records] == [said] * 3


def test_a_mapping_of_tasks_is_one_policy_with_a_checkpoint_for_each() -> None:
    given = {
        "mine": {"RememberColor3-v0": "runs/three", "RememberColor9-v0": Path("runs/nine")},
        "still": "hold",
    }
    assert entries_of(given) == [
        "mine:RememberColor3-v0=runs/three",
        "mine:RememberColor9-v0=runs/nine",
        "still=hold",
    ]
    with pytest.raises(RecipeError, match="expected the folder of a checkpoint for each task"):
        entries_of({"mine": {"RememberColor3-v0": Still()}})


@pytest.mark.parametrize("given", [Still, Still()], ids=["class", "instance"])
def test_the_same_call_in_this_process_leaves_the_class_as_it_is_and_resumes(
    given: object, tmp_path: Path
) -> None:
    act, settings = Still.act, {**FAST, "tasks": TASK, "episodes": 1, "in_process": True, "out": tmp_path}
    first = vla_eval.evaluate(policy={"mine": given}, **settings)
    assert Still.act is act  # the copy's methods would read a copy of this module's variables
    again = vla_eval.evaluate(policy={"mine": given}, **settings)
    assert str(first.table("csv")) == str(again.table("csv"))


def test_numbers_of_numpy_are_numbers(tmp_path: Path) -> None:
    run = vla_eval.evaluate(
        **{**FAST, "episodes": 1, "in_process": True, "tasks": TASK, "out": tmp_path},
        policy="oracle",
        n_action_steps=np.array([1, 4]),
    )
    assert list(run.to_pandas(kind="episodes")["n_action_steps"]) == [1, 4]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: vla_eval.evaluate(policy="oracle", task=TASK), "'task'. Did you mean 'tasks'?"),
        (lambda: vla_eval.evaluate(policy="oracle", tasks=TASK, device="cuda"), "args: {device: cuda}"),
        (lambda: vla_eval.evaluate(policy="oracle", tasks=TASK, max_steps=9), "env.horizon_steps"),
        (lambda: vla_eval.check_policy(Bare()), "`act` returns an ActionChunk. Found: ndarray."),
    ],
)
def test_a_slip_in_a_call_is_answered_with_what_is_meant(call: Any, words: str) -> None:
    with pytest.raises(VlaEvalError) as raised:
        call()
    assert words in str(raised.value)


class Bare(Still):
    """Returns an array in place of a chunk."""

    def act(self, window: ObservationWindow) -> Any:
        return super().act(window).actions
