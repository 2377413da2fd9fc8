"""Results in a model card: what is written is read back, other results stay, and claims are made of it."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.results.stored_runs import COLOR, INTERCEPT, episodes, stored
from vla_eval.cli.main import main
from vla_eval.errors import RecipeError, ReportError
from vla_eval.results.claimed.claims import read_claim
from vla_eval.results.exported.model_card import results_of_card, with_results
from vla_eval.results.report import build_table
from vla_eval.results.success_table import Table

CARD = """---
license: mit
model-index:
- name: mine
  results:
  - task: {type: robotics}
    dataset: {type: libero, name: LIBERO-10}
    metrics: [{type: success_rate, value: 0.5}]
---

# A policy
"""


def table(outcomes: str = "++-e", k: int = 4) -> Table:
    own = [*episodes("p", outcomes, n_action_steps=k), *episodes("p", "++", n_action_steps=k, task=INTERCEPT)]
    return build_table([stored(own, episodes("cue_blind", "--", n_action_steps=k))])


def metadata(card: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(card.split("---")[1])
    return found


def test_what_is_written_is_read_back_and_controls_are_left_out(tmp_path: Path) -> None:
    file = tmp_path / "README.md"
    file.write_text(with_results("", table(), where="card"), encoding="utf-8")
    found = {
        one.task: (one.n_action_steps, one.n_success, one.n_episodes) for one in results_of_card(tmp_path)
    }
    assert found == {COLOR: (4, 2, 3), INTERCEPT: (4, 2, 2)}
    assert results_of_card(file) == results_of_card(tmp_path)


def test_what_a_card_has_besides_stays_and_the_same_figure_is_replaced() -> None:
    once = with_results(CARD, table("++-"), where="card")
    twice = with_results(once, table("+++"), where="card")
    other_k = with_results(twice, table("---", k=8), where="card")
    (model,) = metadata(other_k)["model-index"]
    assert (metadata(other_k)["license"], model["name"]) == ("mit", "mine")
    assert other_k.rstrip().endswith("# A policy")
    rows = [
        (one["dataset"]["name"], one["dataset"].get("config"), one["metrics"][0]["value"])
        for one in model["results"]
    ]
    assert sorted(rows, key=str) == sorted(
        [
            ("LIBERO-10", None, 0.5),
            (COLOR, "K=4", 1.0),
            (INTERCEPT, "K=4", 1.0),
            (COLOR, "K=8", 0.0),
            (INTERCEPT, "K=8", 1.0),
        ],
        key=str,
    )


def test_a_card_is_a_claim_with_what_it_says_of_its_making(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text(with_results(CARD, table(), where="card"), encoding="utf-8")
    found = read_claim(str(tmp_path), task=COLOR)
    assert (found.claim.n_success, found.claim.n_episodes, found.n_action_steps) == (2, 3, 4)
    assert any(note.startswith("the card says: horizon") for note in found.notes)
    with pytest.raises(RecipeError, match="expected one claim, found"):
        read_claim(str(tmp_path))
    with pytest.raises(RecipeError, match="expected a result with task RememberShape3-v0"):
        read_claim(str(tmp_path / "README.md"), task="RememberShape3-v0")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("---\nmodel-index: 7\n---\n", "expected a model card"),
        ("---\n- a\n---\n", "expected a model card"),
        ("---\na: [\n---\n", "expected a model card"),
        ("---\na: !!python/object/apply:os.system [touch x]\n---\n", "expected a model card"),
    ],
)
def test_what_is_no_card_is_one_message(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text(text, encoding="utf-8")
    with pytest.raises(ReportError, match=says):
        results_of_card(tmp_path)
    with pytest.raises(ReportError, match=says):
        with_results(text, table(), where="card")


@pytest.mark.parametrize("counts", ["{}", "{n_success_once: 3}", "{n_success_once: 3.5, n_episodes: 4}", "7"])
def test_a_rate_without_counts_is_no_claim(counts: str, tmp_path: Path) -> None:
    result = f"""
  - task: {{type: robotics}}
    dataset: {{type: mikasa-robo/{COLOR}, name: {COLOR}, config: K=4}}
    metrics: [{{type: success_once, value: 0.9, args: {counts}}}]
"""
    text = f"---\nmodel-index:\n- name: p\n  results:{result}---\n"
    (tmp_path / "README.md").write_text(text, encoding="utf-8")
    with pytest.raises(ReportError, match="expected the counts n_success_once and n_episodes"):
        read_claim(str(tmp_path))


def test_a_card_of_several_policies_is_refused() -> None:
    several = build_table([stored(episodes("p", "+"), episodes("q", "+"))])
    with pytest.raises(ReportError, match="expected rows of one, found p, q"):
        with_results("", several, where="card")
    with pytest.raises(ReportError, match="found none"):
        with_results("", build_table([stored(episodes("oracle", "+"))]), where="card")


def test_the_command_writes_into_the_card(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], in_this_process: None
) -> None:
    run, card = tmp_path / "run", tmp_path / "README.md"
    card.write_text(CARD, encoding="utf-8")
    command = ["eval", "--task", COLOR, "--policy", "random", "--episodes", "2", "--workers", "1"]
    assert main([*command, "--set", "simulator=fake", "--out", str(run)]) == 0
    capsys.readouterr()
    assert main(["report", str(run), "--card", str(card)]) == 1
    assert "expected rows of one, found none" in capsys.readouterr().err
    assert card.read_text(encoding="utf-8") == CARD
