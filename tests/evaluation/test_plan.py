"""What an evaluation will run, in which order, and what two runs are compared by."""

import json
from collections import Counter
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from tests.config.eval_configs import config
from tests.evaluation.resolved import fingerprint, make_plan, results_config
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import to_data
from vla_eval.envs.factory import describe_env
from vla_eval.errors import (
    MissingInstructionError,
    RecipeError,
    SpecMismatchError,
    TaskArgumentError,
    UnknownNameError,
)
from vla_eval.evaluation import plan as planning
from vla_eval.evaluation import worker
from vla_eval.evaluation.job_queue import JobQueue
from vla_eval.evaluation.resolve import resolve
from vla_eval.strict.decoding import decode
from vla_eval.tasks.arguments import offered_by
from vla_eval.tasks.catalog import TASKS, task_spec

LEROBOT = {"version": 2, "description": "d", "adapter": "lerobot", "args": {"checkpoint": "none"}}


class TestPlan:
    def test_every_episode_is_planned_once(self) -> None:
        plan = make_plan(
            config(
                tasks=["RememberColor3-v0", "ShellGameTouch-v0"], n_action_steps=[1, 4], episodes=3, runs=2
            )
        )

        keys = [job.key for job in plan.jobs]
        # 2 tasks x 1 policy x 2 K x 2 runs x 3 seeds
        assert len(keys) == len(set(keys)) == 24
        assert keys[0] == ("RememberColor3-v0", "random", 1, 0, 1)
        assert keys[-1] == ("ShellGameTouch-v0", "random", 4, 1, 3)

    def test_an_environment_is_described_once_for_all_that_run_in_it(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        described = []
        for module in (planning, worker):
            monkeypatch.setattr(
                module,
                "describe_env",
                lambda env: described.append(env.task) or describe_env(env),
                raising=False,
            )
        tasks = ["RememberColor5-v0", "ShellGameTouch-v0"]
        plan = make_plan(config(tasks=tasks, policies=["random", "hold"], n_action_steps=[1, 4], episodes=2))

        for group in (job.group for job in plan.jobs):
            assert group.offered == offered_by(task_spec(group.key.task), {})
            assert worker.make_policy(group).spec.name == group.key.policy
        assert {job.group.key.task: job.group.n_candidates for job in plan.jobs} == dict(
            zip(tasks, (5, 3), strict=True)
        )
        assert described == tasks

    def test_a_policy_that_needs_candidates_is_left_out_where_there_are_none(self) -> None:
        plan = make_plan(
            config(tasks=["RememberColor3-v0", "InterceptMedium-v0"], policies=["random", "tour"], episodes=1)
        )

        assert [job.key[:2] for job in plan.jobs] == [
            ("RememberColor3-v0", "random"),
            ("RememberColor3-v0", "tour"),
            ("InterceptMedium-v0", "random"),
        ]
        assert plan.left_out == ("tour on InterceptMedium-v0: it needs candidates, and this task has none",)

    def test_a_policy_s_own_n_action_steps_holds_where_none_is_named(self, tmp_path: Path) -> None:
        recipe = tmp_path / "eight.yaml"
        recipe.write_text("version: 1\ndescription: d\nadapter: random\ndefault_n_action_steps: 8\n")

        plan = make_plan(config(policies=[str(recipe)], episodes=1))

        assert [job.key.n_action_steps for job in plan.jobs] == [8]
        assert [job.key.policy for job in plan.jobs] == ["eight"]

    def test_an_unknown_task_is_refused_before_anything_runs(self) -> None:
        with pytest.raises(UnknownNameError, match="Did you mean 'RememberColor3-v0'"):
            make_plan(config(tasks=["RememberColour3-v0"]))

    def test_a_task_without_instruction_is_refused_before_anything_runs(self, tmp_path: Path) -> None:
        prompts = tmp_path / "own.yaml"
        prompts.write_text("version: 1\ndescription: d\nsource: s\ninstructions: {ShellGameTouch: [go]}\n")

        with pytest.raises(MissingInstructionError, match=r"own\.yaml: RememberColor3-v0 .*'RememberColor'"):
            make_plan(config(prompt_set=str(prompts)))

    def test_a_name_that_no_record_may_have_is_refused_before_anything_runs(self, tmp_path: Path) -> None:
        recipe = tmp_path / "a\\b.yaml"
        recipe.write_text("version: 1\ndescription: d\nadapter: random\n")

        with pytest.raises(RecipeError, match=r"the file is called 'a\\\\b'.*Rename the file"):
            make_plan(config(policies=[str(recipe)]))

    def test_a_change_that_no_episode_of_the_task_can_have_is_refused(self) -> None:
        for fields, message in (
            ({"tasks": ["InterceptMedium-v0"], "cue_view": "hidden"}, "this task has no cue phase"),
            ({"tasks": ["InterceptMedium-v0"], "cue_view": "first_frame"}, "this task has no cue phase"),
            ({"env": {"cue_steps": 0, "delay_steps": 0}, "cue_view": "hidden"}, "has no cue phase"),
            ({"reset_policy_at_step": 60}, "the episode ends after 60 steps: nothing would be reset"),
        ):
            with pytest.raises(TaskArgumentError, match=message):
                make_plan(config(**fields))
        official = {"tasks": ["mikasa_vla/RememberColor3-VLA-v0"], "cue_view": "hidden"}
        with pytest.raises(SpecMismatchError, match="cannot tell where in its images the cue is"):
            make_plan(config(**official))
        make_plan(config(reset_policy_at_step=59, cue_view="hidden"))

    def test_an_instruction_in_env_is_refused_because_no_policy_would_see_it(self) -> None:
        with pytest.raises(RecipeError, match="prompt_set"):
            make_plan(config(env={"instruction": "go"}))

    def test_only_what_moves_a_result_is_compared(self) -> None:
        base = config()

        same = config(workers=3, timeouts={"step_seconds": 1.0}, max_consecutive_errors=2, description="d")
        assert fingerprint(same) == fingerprint(base)
        for field, value in {
            "episodes": 5,
            "env": {"a": 1},
            "prompt_set": "p",
            "render": {"wrist_mesh": "simplified"},
        }.items():
            assert fingerprint(config(**{field: value})) != fingerprint(base), field
        assert {"workers", "timeouts", "name"}.isdisjoint(results_config(base))

    def test_a_compiled_network_is_another_run_and_one_that_is_not_has_the_digest_that_it_had(
        self, tmp_path: Path
    ) -> None:
        (tmp_path / "mine.yaml").write_text(json.dumps(LEROBOT))
        fields: dict[str, Any] = {"policies": [str(tmp_path / "mine.yaml"), "oracle"]}
        plain, compiled = (resolve(config(**fields, compile=value)) for value in (False, True))

        assert "compile" not in plain.results_config
        assert plain.fingerprint == resolve(config(**fields)).fingerprint != compiled.fingerprint
        assert [entry.value.args.get("compile") for entry in compiled.policies] == [True, None]
        assert [entry.recipes[0].sha256 for entry in compiled.policies] == [
            entry.recipes[0].sha256 for entry in plain.policies
        ]

    def test_to_compile_is_refused_where_no_policy_has_a_network(self) -> None:
        with pytest.raises(RecipeError, match=r"compile: expected a policy with a checkpoint, found random"):
            resolve(config(policies=["random"], compile=True))

    def test_plain_data_can_be_decoded_again(self) -> None:
        original = config(n_action_steps=[1, 2], env={"velocity_range_m_s": [0.1, 0.2]})

        assert decode(EvalConfig, to_data(original), where="x") == original


class TestRunSeeds:
    def test_checkpoints_of_different_kinds_are_not_runs_of_one_policy(self) -> None:
        with pytest.raises(RecipeError, match="found adapter random in random and hold in hold"):
            make_plan(config(policies=["mine=random,hold"]))

    def test_a_checkpoint_named_twice_would_count_as_two_trainings(self) -> None:
        with pytest.raises(RecipeError, match="are the same checkpoint"):
            make_plan(config(policies=["mine=random,random"]))

    def test_a_policy_server_is_no_run_seed(self) -> None:
        with pytest.raises(RecipeError, match=r"found ws://127\.0\.0\.1:1"):
            make_plan(config(policies=["mine=random,ws://127.0.0.1:1"]))

    def test_other_policies_have_as_many_runs_or_one(self, tmp_path: Path) -> None:
        policies = ["hold", f"mine=random,{random_again(tmp_path)}"]

        counts = [
            Counter(
                (job.key.policy, job.key.run) for job in make_plan(config(policies=policies, **more)).jobs
            )
            for more in ({"runs": 1, "episodes": 5}, {"runs": 2, "episodes": 5})
        ]

        mine = {("mine", 0): 5, ("mine", 1): 5}
        assert counts == [{("hold", 0): 5} | mine, {("hold", 0): 5, ("hold", 1): 5} | mine]
        with pytest.raises(RecipeError, match="runs: 3, but policy 'mine' has 2 checkpoints"):
            make_plan(config(policies=policies, runs=3))

    def test_a_name_for_one_checkpoint_is_its_name_in_records(self) -> None:
        (job,) = make_plan(config(policies=["mine=random"], episodes=1)).jobs
        assert (job.key.policy, job.key.run, job.group.adapter) == ("mine", 0, "random")


class TestOneCheckpointPerTask:
    TASKS = ("RememberColor3-v0", "ShellGameTouch-v0")

    def test_a_mapping_and_entries_for_single_tasks_say_the_same(self) -> None:
        color, shell = self.TASKS
        entries = ["hold", f"mine:{color}=a,b", f"mine:{shell}=c"]

        written = decode(
            EvalConfig,
            {
                "name": "n",
                "tasks": list(self.TASKS),
                "policies": ["hold", {"mine": {color: ["a", "b"], shell: "c"}}],
            },
            where="x",
        )

        assert written == config(name="n", tasks=list(self.TASKS), policies=entries)
        assert decode(EvalConfig, to_data(written), where="x") == written

    @pytest.mark.parametrize(
        "entry", [3, {"mine": 3}, {"mine": {"A-v0": []}}, {"mine": {"A-v0": [1]}}, {3: "a"}]
    )
    def test_an_entry_that_is_neither_names_what_may_stand_there(self, entry: object) -> None:
        with pytest.raises(RecipeError, match=r"policies.*expected (text|names, or NAME: {TASK: DIR})"):
            decode(EvalConfig, {"name": "n", "tasks": ["A-v0"], "policies": [entry]}, where="x")

    def test_each_task_has_the_recipe_and_the_runs_of_its_own_checkpoints(self, tmp_path: Path) -> None:
        color, shell = self.TASKS
        policies = ["hold", f"mine:RememberColor3=random,{random_again(tmp_path)}", f"mine:{shell}=hold"]

        plan = make_plan(config(tasks=list(self.TASKS), policies=policies, episodes=1))

        adapters = {(job.key.task, job.key.policy, job.key.run): job.group.adapter for job in plan.jobs}
        assert adapters == {
            (color, "hold", 0): "hold",
            (color, "mine", 0): "random",
            (color, "mine", 1): "random",
            (shell, "hold", 0): "hold",
            (shell, "mine", 0): "hold",
        }
        assert plan.policy_names == ("hold", "mine")
        again = sha256(random_again(tmp_path).read_bytes()).hexdigest()
        assert plan.recipe_hashes[f"policies/mine/{color}/run-1"] == again
        assert plan.recipe_hashes[f"policies/mine/{shell}/run-0"] == plan.recipe_hashes["policies/hold"]

    @pytest.mark.parametrize(
        ("more", "message"),
        [
            (
                (),
                r"found those for RememberColor3-v0 and none for ShellGameTouch-v0. Add mine:Shell",
            ),
            (("mine=random",), r"'mine' is named twice, once for all tasks"),
            (("mine:RememberColor3=hold",), r"'mine/RememberColor3-v0' is named twice"),
            (("mine:RememberColour3-v0=random",), r"Did you mean 'RememberColor3-v0'"),
            (("mine:ShellGameTouch-v0=nothing",), r"no policies/\*.yaml 'nothing'"),
        ],
    )
    def test_a_mistake_is_found_while_planning(self, more: tuple[str, ...], message: str) -> None:
        with pytest.raises((RecipeError, UnknownNameError), match=message):
            make_plan(config(tasks=list(self.TASKS), policies=["mine:RememberColor3-v0=random", *more]))


def random_again(folder: Path) -> Path:
    """Write a recipe that is `random` under another name."""
    path = folder / "again.yaml"
    path.write_text("version: 1\ndescription: d\nadapter: random\n")
    return path


class TestQueue:
    def test_the_first_episode_of_each_checkpoint_comes_first(self, tmp_path: Path) -> None:
        policy = f"mine=random,{random_again(tmp_path)}"
        queue = JobQueue(make_plan(config(policies=[policy], episodes=2)).jobs, finished=())

        order = []
        loaded = None
        while batch := queue.take(loaded):
            loaded = batch.setup_key
            order += [(job.key.run, job.key.seed) for job in batch.jobs]

        assert order == [(0, 1), (1, 1), (1, 2), (0, 2)]

    def test_the_first_episode_of_each_group_comes_first(self) -> None:
        plan = make_plan(config(policies=["random", "hold"], episodes=3))
        queue = JobQueue(plan.jobs, finished=())

        order = []
        loaded = None
        while batch := queue.take(loaded):
            loaded = batch.setup_key
            order += [(job.key.policy, job.key.seed) for job in batch.jobs]

        assert order == [("random", 1), ("hold", 1), ("hold", 2), ("hold", 3), ("random", 2), ("random", 3)]

    def test_a_worker_takes_a_group_that_nobody_has_loaded(self) -> None:
        plan = make_plan(config(policies=["random", "hold"], episodes=3))
        first, _, _, other, *_ = plan.jobs
        queue = JobQueue(plan.jobs, finished={first.key, other.key})

        batch = queue.take(None, taken={first.group.setup_key})

        assert batch is not None
        assert batch.group.key == other.group.key

    def test_finished_episodes_are_not_handed_out(self) -> None:
        plan = make_plan(config(episodes=3))
        queue = JobQueue(plan.jobs, finished={plan.jobs[1].key})

        assert queue.n_batches == 2
        batches = [batch for batch in iter(lambda: queue.take(None), None) if batch]
        assert [[job.seed for job in batch.jobs] for batch in batches] == [[1], [3]]

    def test_a_slot_is_the_seeds_own_whoever_else_is_in_the_batch(self) -> None:
        plan = make_plan(config(episodes=5, slots_per_worker=3))
        queue = JobQueue(plan.jobs, finished={plan.jobs[1].key})

        batches = [batch for batch in iter(lambda: queue.take(None), None) if batch]

        # Seeds 1 … 5 have the slots 0 1 2 0 1; seed 2 is finished.
        assert [[(job.seed, job.slot) for job in batch.jobs] for batch in batches] == [
            [(1, 0), (3, 2)],
            [(4, 0), (5, 1)],
        ]

    def test_in_the_worker_an_episodes_row_of_a_pass_is_its_slot(self) -> None:
        plan = make_plan(config(episodes=5, slots_per_worker=3))

        assert [(job.slot, job.row) for job in plan.jobs] == [(0, 0), (1, 1), (2, 2), (0, 0), (1, 1)]

    def test_a_batch_that_failed_comes_again_one_by_one(self) -> None:
        queue = JobQueue(make_plan(config(episodes=4, slots_per_worker=2)).jobs, finished=())
        failed = queue.take(None)
        assert failed is not None

        queue.put_back_alone(failed)

        assert (queue.n_batches, queue.n_episodes) == (3, 4)
        order = [[job.seed for job in batch.jobs] for batch in iter(lambda: queue.take(None), None) if batch]
        assert order == [[1], [2], [3, 4]]

    def test_one_slot_leaves_no_trace_in_what_runs_are_compared_by(self) -> None:
        assert "slots_per_worker" not in results_config(config())
        assert results_config(config(slots_per_worker=2))["slots_per_worker"] == 2

    def test_a_first_inference_at_the_beginning_is_as_in_runs_that_had_no_choice(self) -> None:
        at_once = results_config(config())
        late = results_config(config(n_action_steps=[4], chunking={"first_inference_step": 3}))
        assert "first_inference_step" not in at_once["chunking"]
        assert late["chunking"]["first_inference_step"] == 3


def test_every_task_has_its_instruction_in_the_paper_s_prompts() -> None:
    plan = make_plan(config(tasks=list(TASKS), episodes=1))

    assert all(job.group.instruction for job in plan.jobs)
