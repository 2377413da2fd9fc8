"""`vla_eval.record`, `finetune`, `run_probe`, `load_dataset`: what their verbs write; answers to mistakes."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest

import vla_eval
from tests.training import tiny_trainings
from vla_eval.api import probing
from vla_eval.cli.main import main
from vla_eval.core import ActionChunk
from vla_eval.errors import FolderInUseError, TaskArgumentError, VlaEvalError
from vla_eval.specs import PolicySpec
from vla_eval.training.finetune import finetune

TASK = "RememberColor3-v0"
cloudpickle.register_pickle_by_value(sys.modules[__name__])


class Still:
    """Holds still."""

    def __init__(self) -> None:
        self.spec = PolicySpec(name="still", reads="last", cameras=(), states=(), chunk_size=4)

    def reset(self, episodes: Any) -> None:
        pass

    def act(self, window: Any) -> ActionChunk:
        return ActionChunk(actions=np.zeros((4, 7), dtype=np.float32))


def test_finetune_and_load_dataset_do_what_the_verbs_do(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tiny_trainings.act(recorded, tmp_path / "function", steps=2)
    verb = finetune(tiny_trainings.act(recorded, tmp_path / "verb", steps=2))
    summary = vla_eval.finetune(config)
    assert (summary.step, summary.is_finished) == (2, True)
    weights = [one.checkpoint / "model.safetensors" for one in (summary, verb)]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    assert vla_eval.finetune(config) == summary  # finished: nothing is trained again

    dataset = vla_eval.load_dataset(recorded)
    assert len(dataset.columns["action"]) == dataset.facts.n_frames
    assert vla_eval.load_dataset(recorded.parent).root == recorded


def test_every_function_refuses_arguments_that_do_not_go_together_before_anything_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    task, env = "SeqOfColors3-v0", {"n_shown": 5, "n_items": 4}
    calls: dict[str, Any] = {
        "evaluate": lambda: vla_eval.evaluate(policy="oracle", tasks=task, env=env),
        "run_probe": lambda: vla_eval.run_probe(policy="oracle", tasks=task, probes="swap", env=env),
        "record": lambda: vla_eval.record(tasks=task, episodes=1, env=env),
        "make_env": lambda: vla_eval.make_env(task, **env),
    }
    for name, call in calls.items():
        with pytest.raises(TaskArgumentError) as found:
            call()
        assert str(found.value) == f"{task}: n_shown=5: expected at most n_items=4.", name
    assert not list(tmp_path.iterdir())


def test_a_policy_of_a_notebook_is_probed_as_a_named_one_is(tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        **{"tasks": TASK, "probes": "swap", "controls": False, "simulator": "fake", "episodes": 2},
        **{"in_process": True, "n_action_steps": 4},
    }
    probe = vla_eval.run_probe(policy={"mine": Still}, out=tmp_path / "probe", **settings)
    assert {row.policy for row in probe.found.rows} == {"mine"}
    arguments = ["probe", "--task", TASK, "--policy", "hold", "--probe", "swap", "--no-controls"]
    small = ["--episodes", "2", "--n-action-steps", "4", "--workers", "1", "--set", "simulator=fake"]
    assert main([*arguments, *small, "--out", str(tmp_path / "verb")]) == 0
    named = vla_eval.run_probe(policy="hold", out=tmp_path / "verb", **settings)  # all is there
    assert str(named.table()).replace("hold", "mine") == str(probe.table())


def test_a_world_that_another_process_is_writing_comes_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tried: list[str] = []

    def run_or_resume(*_: Any, out: Path, **__: Any) -> None:
        tried.append(out.name)
        if len(tried) == 1:
            raise FolderInUseError(f"{out}: another process (pid 1) is writing into it.")

    monkeypatch.setattr(probing, "run_or_resume", run_or_resume)
    monkeypatch.setattr(probing, "read_probe", lambda worlds, out: len(worlds))
    monkeypatch.setattr(probing, "write_retention", lambda *_: ())
    found = vla_eval.run_probe(policy="oracle", tasks=TASK, probes=["swap", "blank"], out=tmp_path)
    first, *others = tried
    assert len(tried) == found.found + 1 and others[-1] == first
    assert "another process is writing into it; it comes last." in capsys.readouterr().err


TINY = {"policy": tiny_trainings.TINY_ACT, "num_workers": 0, "save_every_steps": 2}
SMALL = {
    "probes=[": 'simulator="fake", probes=[',
    "episodes=10": "episodes=1",
    'out="data/mine")': 'out="data/mine", workers=2, env={"delay_steps": 1})',
    "steps=2000, batch_size=8": f"steps=2, batch_size=2, finetune={TINY}",
    "episodes=20": 'episodes=1, simulator="fake"',
}


@pytest.mark.slow  # what it does is tried by itself above, and without a main guard in `test_evaluate`
@pytest.mark.parametrize("recorded_on", ["fake", "maniskill"])
def test_the_page_on_python_is_a_script_without_a_main_guard_also_after_the_fake_simulator(
    recorded_on: str, tmp_path: Path
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
    blocks = [block.partition("```")[0] for block in page.split("```python\n")[1:]]
    script = "\n".join((blocks[0].partition("\n\nrun =")[0], *blocks[2:]))
    for shown, small in SMALL.items():
        assert shown in script
        script = script.replace(shown, small)
    script = script.replace("workers=2", f'workers=2, simulator="{recorded_on}"')
    (tmp_path / "script.py").write_text(f"{script}\nprint(run, dataset.was_replayed)", "utf-8")
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].endswith(": 1 episodes> True")
    assert "swap 1" in done.stdout and "follows.png" in done.stdout


@pytest.mark.parametrize(
    ("function", "given", "said"),
    [
        ("record", {}, "`tasks` is missing"),
        ("record", {"tasks": "RemberColor3-v0"}, "RememberColor3-v0"),
        ("record", {"tasks": TASK, "episode": 3}, "episodes"),
        ("record", {"tasks": TASK, "env": {"delay_step": 3}}, "delay_steps"),
        ("finetune", {"policy": "act"}, "`dataset` is missing"),
        ("finetune", {"policy": "actt", "dataset": "."}, "'act'"),
        ("finetune", {"policy": "act", "dataset": "nowhere"}, "nowhere"),
        ("finetune", {"policy": "act", "dataset": ".", "step": 3}, "step"),
        ("run_probe", {"tasks": TASK}, "`policy` is missing"),
        ("run_probe", {"tasks": TASK, "policy": "oracle", "probes": "swop"}, "swap"),
        ("run_probe", {"tasks": TASK, "policy": "oracle", "delays": [-1]}, "≥ 0"),
        ("run_probe", {"tasks": TASK, "policy": 3}, "has no spec"),
    ],
)
def test_a_mistake_is_answered_with_what_was_expected(
    function: str, given: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(VlaEvalError, match=said):
        getattr(vla_eval, function)(**given)
    assert not list(tmp_path.iterdir())
