"""An imitation learns what its expert did in episodes that were like the agent's, with any core."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3", reason="needs `make rl`")

from tests.agents.test_observing import robot_reader, seen
from tests.agents.tiny_agents import BIT, ROBOT, tiny, trained
from vla_eval.agents.expert import Demonstration, Expert, touched_next
from vla_eval.agents.imitation import Demonstrations
from vla_eval.agents.job import agent_job
from vla_eval.agents.train import environments, train_agent
from vla_eval.cli.main import main
from vla_eval.config.agents import AgentTable, is_agent_table
from vla_eval.config.files import load_recipe
from vla_eval.core import Observation, StepResult
from vla_eval.errors import RecipeError, TrainingError, VlaEvalError
from vla_eval.models.cores.sizes import CORES
from vla_eval.policies.agents.imitator import CoreNetwork, as_inputs, exchanged
from vla_eval.policies.agents.observing import PLACES, VECTOR, action_space, given_space
from vla_eval.storage.run_folder import read_run
from vla_eval.task_state import PrivilegedState, TaskStatus

pytestmark = pytest.mark.usefixtures("in_this_process", "light_workers")
SIZES = {"width": 16, "layers": 2, "heads": 2, "context_steps": 4}
FEW = {"elmur": {"slots": 4, "experts": 2}}


def expert(out: Path, task: str, **changes: Any) -> Expert:
    job = agent_job(tiny("imitation", out, task, **changes))
    found = environments(job, logs=out / "logs").expert
    assert found is not None
    return found


def network(core: str, task: str, out: Path) -> CoreNetwork:
    """Return a network that is given five numbers, and on a robot the places of four candidates."""
    torch.manual_seed(0)
    action = action_space(agent_job(tiny("imitation", out, task)).env.action)
    sizes = {**SIZES, "core": core, "core_options": FEW.get(core, {})}
    shapes: dict[str, tuple[int, ...]] = {VECTOR: (5,), **({PLACES: (4, 3)} if task == ROBOT else {})}
    return CoreNetwork(given_space(shapes), action, None, **sizes).eval()


@pytest.mark.parametrize("task", [pytest.param(ROBOT, marks=pytest.mark.slow), BIT])
@pytest.mark.parametrize("core", CORES)
def test_step_by_step_a_core_answers_what_it_was_taught_at_once(core: str, task: str, tmp_path: Path) -> None:
    made = network(core, task, tmp_path)
    generator = torch.Generator().manual_seed(1)
    inputs = torch.randn(1, 11, 5 + 3 * made.n_places, generator=generator)
    made.set_statistics(inputs[0])
    with torch.inference_mode():
        at_once = made(inputs, made.core.begin(1))[0].action[0]
    expected = at_once.split(made.counts, dim=-1) if made.counts else at_once.clamp(-1, 1)
    state = None
    for step in range(11):
        seen = {VECTOR: inputs[:, step, :5].numpy()}
        if made.n_places:
            seen[PLACES] = inputs[:, step, 5:].reshape(1, -1, 3).numpy()
        action, state = made.predict(
            seen, state=state, episode_start=np.array([step == 0]), deterministic=True
        )
        wanted = [int(part[step].argmax()) for part in expected] if made.counts else expected[step].tolist()
        np.testing.assert_allclose(action[0], wanted, atol=1e-4)


def test_what_is_learned_is_what_the_agent_would_see_and_the_expert_asked_for(tmp_path: Path) -> None:
    """Of MemoryLength: the bit is shown first, and named at the end; the horizon is 11."""
    (batch,) = expert(tmp_path / "run", BIT).demonstrations(2, noise=0.0)
    assert [len(one.inputs) for one in batch] == [len(one.actions) for one in batch] == [11, 11]
    assert all(one.actions[-1, 0] in (0, 1) and set(one.meant) == {-1} for one in batch)
    (again,) = expert(tmp_path / "again", BIT).demonstrations(2, noise=0.0)
    for one, other in zip(batch, again, strict=True):
        np.testing.assert_array_equal(one.inputs, other.inputs)
        np.testing.assert_array_equal(one.actions, other.actions)
    (other_seed,) = expert(tmp_path / "other", BIT, run_seed=1).demonstrations(2, noise=0.0)
    assert any((one.inputs != other.inputs).any() for one, other in zip(batch, other_seed, strict=True))


def test_padding_teaches_nothing() -> None:
    def ones(n_steps: int, value: float) -> Demonstration:
        return Demonstration(
            np.full((n_steps, 3), value, np.float32),
            np.full((n_steps, 1), value, np.float32),
            np.full(n_steps, 1, np.int64),
        )

    found = Demonstrations.of([ones(2, 1.0), ones(5, 2.0)])
    assert found.is_step.sum(dim=1).tolist() == found.n_steps.tolist() == [2, 5]
    assert found.inputs[0, :2].min() == 1 and found.inputs[1].min() == 2
    assert found.actions.shape == (2, 5, 1) and found.meant.shape == (2, 5)


def test_what_is_meant_is_what_is_touched_next_while_candidates_are_in_view() -> None:
    """Touches at steps 3 and 5; candidates are in view from step 1 on; nothing is touched after step 5."""
    touched: list[tuple[int, ...]] = [(), (), (), (2,), (2,), (2, 0), (2, 0)]
    observation = Observation(step=0, images={}, state={})
    results = [
        StepResult(
            observation=observation,
            status=TaskStatus(phase="response" if step else "cue", success=False, touched_candidates=now),
        )
        for step, now in enumerate(touched)
    ]
    assert touched_next(results).tolist() == [-1, 2, 2, 0, 0, -1]


def test_candidates_that_exchange_are_seen_as_if_the_world_were_so() -> None:
    """The cue, then all three in view: once as they are, once exchanged by hand."""
    order = np.array([2, 0, 1])  # what was candidate 2 is now candidate 0, and so on
    read = robot_reader("vector").read
    inputs = []
    for is_exchanged in (False, True):
        rng = np.random.default_rng(7)
        cue = seen(rng, phase="cue", right=(2,), shown=(2,))
        choice = seen(rng, phase="response", right=(2,), shown=())
        if is_exchanged:
            assert isinstance(cue.privileged, PrivilegedState)
            assert isinstance(choice.privileged, PrivilegedState)
            cue = replace(cue, privileged=replace(cue.privileged, shown_candidates=(0,)))
            places = choice.privileged.candidate_positions_m[order]
            choice = replace(choice, privileged=replace(choice.privileged, candidate_positions_m=places))
        inputs.append(np.stack([as_inputs(read(one)) for one in (cue, choice)]))
    found, meant = exchanged(
        torch.from_numpy(inputs[0])[None], torch.tensor([[-1, 2]]), torch.from_numpy(order)[None]
    )
    np.testing.assert_array_equal(found[0].numpy(), inputs[1])
    assert meant.tolist() == [[-1, 0]]


def test_a_step_without_a_candidate_that_is_meant_costs_nothing(tmp_path: Path) -> None:
    made = network("gru", ROBOT, tmp_path)
    inputs = torch.zeros(1, 2, 5 + 3 * made.n_places)
    answers, _ = made(inputs, made.core.begin(1))
    actions, meant = answers.action.detach() + 0.5, torch.tensor([[-1, 1]])
    found = made.errors(answers, actions, meant, meant_weight=2.0)
    assert answers.meant is not None
    expected = -float(answers.meant[0, 1].detach().log_softmax(dim=-1)[1])
    assert found[0].tolist() == pytest.approx([0.25, 0.25 + 2 * expected])


@pytest.mark.parametrize(
    ("task", "changes", "error", "message"),
    [
        (BIT, {"arguments": {"action_noise": 0.1}}, RecipeError, "have no arm to push"),
        (ROBOT, {"observation": "rgb_joints"}, RecipeError, "is given images"),
        (BIT, {"network": {"core": "grru"}}, VlaEvalError, "Did you mean 'gru'"),
        (
            BIT,
            {"network": {"core": "transformer", "width": 10, "heads": 4}},
            RecipeError,
            r"train_agent.network.width is 10, expected a multiple of 2 · heads \(8\)",
        ),
        (
            BIT,
            {
                "network": {
                    "core": "rate",
                    "width": 10,
                    "core_options": {"memory_tokens": 2, "valve_heads": 4},
                }
            },
            RecipeError,
            r"expected a multiple of valve_heads \(4\)",
        ),
        (
            BIT,
            {"network": {"core": "gru", "core_options": {"keep_bas": 1}}},
            VlaEvalError,
            "train_agent.network.core_options .*Did you mean 'keep_bias'",
        ),
        (BIT, {"arguments": {"exchange_share": 0.5}}, RecipeError, "exchange_share is 0.5: .* no candidates"),
        (
            ROBOT,
            {"arguments": {"exchange_share": 1.5}},
            RecipeError,
            "exchange_share is 1.5, expected 0 to 1",
        ),
        (BIT, {"network": {"net_arch": [8]}}, VlaEvalError, "net_arch"),
        (BIT, {"network": {"width": 0}}, VlaEvalError, "width"),
        (ROBOT, {"reward": "sparse"}, RecipeError, "learns from no reward"),
        (BIT, {"arguments": {"demonstrations": True}}, RecipeError, "expected a whole number"),
        (BIT, {"arguments": {"batch_size": 0}}, RecipeError, "batch_size is 0, expected"),
        (BIT, {"arguments": {"demonstrations": 0}}, RecipeError, "demonstrations is 0, expected"),
    ],
)
def test_a_mistake_is_one_message(
    task: str, changes: dict[str, Any], error: type[VlaEvalError], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        train_agent(tiny("imitation", tmp_path / "run", task, train_agent=changes))
    assert not (tmp_path / "run" / "train").exists()


def test_an_expert_that_fails_too_often_ends_the_training(tmp_path: Path) -> None:
    """The response begins at step 10: in two more steps nothing is reached."""
    changes = {"env": {"horizon_steps": 12}, "arguments": {"demonstrations": 2}}
    with pytest.raises(TrainingError, match="the expert succeeded in 0 of 10 episodes, and 2 demonstrations"):
        train_agent(tiny("imitation", tmp_path / "run", train_agent=changes))


def test_a_gru_learns_a_bit_and_an_mlp_does_not(tmp_path: Path) -> None:
    returns = {}
    for core in ("gru", "mlp"):
        fields = {
            "steps": 120,
            "save_every_steps": 120,
            "n_envs": 16,
            "arguments": {"demonstrations": 64, "batch_size": 32, "learning_rate": 0.005},
            "network": {"core": core, "width": 32},
        }
        run = trained(tiny("imitation", tmp_path / core, BIT, train_agent=fields))
        assert (run / "curve.png").read_bytes().startswith(b"\x89PNG")
        command = ["eval", "--task", BIT, "--policy", str(run), "--episodes", "40", "--workers", "1"]
        assert main([*command, "--out", str(tmp_path / f"{core}-evaluated")]) == 0
        records = read_run(tmp_path / f"{core}-evaluated").records
        returns[core] = float(np.mean([record.episode_return for record in records]))
    assert returns["gru"] == 1.0
    assert abs(returns["mlp"]) < 0.5  # 0 by chance, with a standard deviation of 0.16


def test_the_two_tables_of_the_ladder_have_the_same_cores() -> None:
    tables = [load_recipe("configs", f"ladder_{end}", AgentTable).value for end in ("base", "robots")]
    assert tables[0].variants == tables[1].variants
    assert tables[0].train_agent == tables[1].train_agent
    assert {one["network"]["core"] for one in tables[0].variants.values()} == set(CORES)
    assert all(is_agent_table(f"ladder_{end}") for end in ("base", "robots"))


def test_variants_are_trained_beside_each_other_and_named_in_the_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    sizes = "steps: 16, save_every_steps: 16, n_envs: 2, arguments: {demonstrations: 2, batch_size: 2}"
    table = f"""name: mine
policies: [imitation_base]
tasks: [{BIT}]
train_agent: {{{sizes}}}
variants:
  small: {{network: {{width: 4}}}}
  large: {{network: {{width: 8}}, arguments: {{batch_size: 1}}}}
"""
    Path("mine.yaml").write_text(table, encoding="utf-8")
    assert main(["train-agent", "mine.yaml", "--out", "out"]) == 0
    assert {path.name for path in Path("out").iterdir() if path.is_dir()} == {
        "small-mikasa_base-MemoryLengthEasy-v0-0",
        "large-mikasa_base-MemoryLengthEasy-v0-0",
    }
    said = Path("out/eval.yaml").read_text(encoding="utf-8")
    assert "small:mikasa_base/MemoryLengthEasy-v0=" in said and "large:" in said
    Path("mine.yaml").write_text(table.replace("_base]", "_base, ppo_base]"), encoding="utf-8")
    capsys.readouterr()
    assert main(["train-agent", "mine.yaml", "--out", "out"]) == 1
    assert "expected one recipe in `policies`" in " ".join(capsys.readouterr().err.split())
