"""The ablation table: each row changes one setting of a recipe, and names of former recipes resolve to it."""

import logging
from pathlib import Path
from typing import Any

import pytest

from tests.training import tiny_trainings
from vla_eval.cli.main import main
from vla_eval.config.files import list_recipes, load_recipe, to_data
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe
from vla_eval.config.policy import PolicyRecipe, load_policy
from vla_eval.errors import UnknownNameError
from vla_eval.evaluation.model_table import gpu_hours, load_model_table
from vla_eval.models.octo.configuration_octo import MikasaOctoConfig
from vla_eval.strict.decoding import warn_renamed
from vla_eval.training.request import load_finetune_recipe, run_folder_of

BOTH = ["observation.images.base", "observation.images.wrist"]
FORMER: dict[str, tuple[str, dict[str, Any]]] = {
    "octo_small_positions": ("octo_small", {"trained": "heads_and_positions"}),
    "octo_small_window2": ("octo_small", {"window": 2}),
    "octo_small_full": ("octo_small", {"trained": "all"}),
    "octo_small_cached": ("octo_small", {"augment": False, "remember_readouts": True}),
    "openvla_oft_k4": ("openvla_oft", {"chunk_size": 4, "n_action_steps": 4}),
    "openvla_oft_public": ("openvla_oft", {}),  # twice as many steps
    "spatialvla_wrist": ("spatialvla", {"pictures": BOTH}),
    "spatialvla_embeddings": ("spatialvla", {"train_spatial_embeddings": True}),
    "spatialvla_kept_grid": ("spatialvla", {"action_grid": "kept"}),
}
"""Name of a former recipe -> the recipe that it differed from, and the fields of its policy."""


@pytest.fixture(autouse=True)
def a_process_that_has_not_warned_yet() -> None:
    warn_renamed.cache_clear()


def section(name: str) -> FinetuneRecipe:
    found = load_finetune_recipe(FinetuneConfig(policy=name, dataset="d")).value
    assert isinstance(found, FinetuneRecipe)
    return found


@pytest.mark.parametrize("name", FORMER)
def test_a_former_recipe_trains_what_it_trained(name: str, caplog: pytest.LogCaptureFixture) -> None:
    base_name, changed = FORMER[name]
    assert name not in list_recipes("policies")
    base, former = load_recipe("policies", base_name, PolicyRecipe).value, load_policy(name)
    assert base.finetune is not None
    expected = {**to_data(base.finetune), "policy": {**base.finetune.policy, **changed}}
    if name == "openvla_oft_public":
        expected["steps"] = 100_000
    assert to_data(section(name)) == expected
    assert (former.name, former.value.version) == (name, base.version)
    assert run_folder_of(FinetuneConfig(policy=name, dataset="d")) == Path(f"runs/{name}-d-0")
    (warning,) = caplog.messages  # once, however often it is looked up
    assert f"mikasa-vla finetune ablations --policy {name}" in warning and base_name in warning


def test_the_rows_are_the_former_recipes_beside_the_recipes_that_they_differ_from() -> None:
    rows = {row.name: row for row in load_model_table("ablations").rows}
    assert rows.keys() == FORMER.keys() | {"octo_small", "openvla_oft", "spatialvla"}
    for name, row in rows.items():
        assert row.policy == (FORMER[name][0] if name in FORMER else name)
        assert (row.finetune is None) == (name not in FORMER)
        # Executed is the whole chunk, as in the paper's table.
        assert row.n_action_steps == (section(name).policy["chunk_size"],)


def test_the_command_line_takes_a_former_name_and_says_which_row_it_is(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    seen = tiny_trainings.asked_for(monkeypatch)
    base = tmp_path / "base"  # only looked for
    base.mkdir()
    for name in ("config.json", "model.safetensors"):
        (base / name).touch()
    finetune = ["finetune", "--policy", "octo_small_window2", "--dataset", str(recorded)]
    assert main([*finetune, "--base-checkpoint", str(base)]) == 0
    assert load_finetune_recipe(seen[0]).value.policy["window"] == 2
    assert "--policy octo_small_window2" in caplog.text


def test_a_recipe_of_the_users_own_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "policies").mkdir()
    text = "version: 7\ndescription: mine\nadapter: lerobot\nfinetune: {type: act}\n"
    (tmp_path / "policies" / "octo_small_full.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    with caplog.at_level(logging.WARNING):
        assert load_policy("octo_small_full").value.version == 7
    assert not caplog.messages


def test_a_name_that_was_never_a_recipe_is_an_error_with_a_suggestion() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'octo_small'"):
        load_policy("octo_smal")


@pytest.mark.parametrize("name", [name for name in FORMER if name.startswith("octo")])
def test_each_row_of_octo_is_a_configuration(name: str) -> None:
    config = MikasaOctoConfig(device="cpu", **section(name).policy)
    assert (config.window, config.chunk_size) == (2 if name.endswith("window2") else 10, 4)


def test_gpu_hours_count_the_steps_that_a_row_sets() -> None:
    rows = {row.name: row for row in load_model_table("ablations").rows}
    short, long = (gpu_hours(rows[name], steps=None) for name in ("openvla_oft", "openvla_oft_public"))
    assert short is not None and long == pytest.approx(2 * short)  # 100,000 steps, not 50,000
