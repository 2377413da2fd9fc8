"""Random JSON in the place of a checkpoint's: it is accepted, or refused with a message.

Of every family its configuration and its processors are read; of some the network is built, without memory.
"""

import contextlib
import dataclasses
import json
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.processor import ProcessorStepRegistry
from safetensors.numpy import save_file

from tests.fuzz.json_cases import accepted_or_refused
from vla_eval.checkpoints.adapter_config import read_adapter_config
from vla_eval.checkpoints.files import checkpoint_sha256
from vla_eval.checkpoints.foreign_code import no_foreign_code
from vla_eval.checkpoints.loading import LoadOptions, config_class, make_empty_policy, read_config
from vla_eval.checkpoints.notes import normalization_notes
from vla_eval.checkpoints.processors import register_steps
from vla_eval.checkpoints.safe_processors import load_processor, resolve_step
from vla_eval.checkpoints.saved_processor import check_paths, read_saved_processor
from vla_eval.errors import VlaEvalError
from vla_eval.models.weights.empty import empty_weights
from vla_eval.policies.recipe import load_policy_recipe

CONFIG, PREPROCESSOR, ADAPTER = "config.json", "policy_preprocessor.json", "adapter_config.json"
NASTY = st.sampled_from(
    (
        *("", ".", "..", "/", "~", "\0", "\ud800", "a" * 5000, "../x.safetensors", "state.safetensors"),
        *("os.system", "lerobot.x", "lerobot.processor.pipeline.ProcessorStep", "normalizer_processor"),
        *("act", "LORA"),
    )
)
LEAVES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([10**9, 10**30])
    | st.floats()
    | st.text(max_size=8)
) | NASTY
NAMES = NASTY | st.text(max_size=8)
VALUES = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=4),
    max_leaves=8,
)
FEATURE = {"type": "STATE", "shape": [3]}
VALID_CONFIG: dict[str, Any] = {
    "type": "act",
    "n_action_steps": 4,
    "chunk_size": 8,
    "input_features": {"observation.state": FEATURE},
    "output_features": {"action": {"type": "ACTION", "shape": [7]}},
}
VALID_STEP: dict[str, Any] = {
    "registry_name": "normalizer_processor",
    "config": {"features": {"observation.state": FEATURE}, "norm_map": {"STATE": "MEAN_STD"}},
    "state_file": "state.safetensors",
}
VALID_ADAPTER: dict[str, Any] = {"peft_type": "LORA", "r": 4, "target_modules": ["q"], "lora_alpha": 8}
ACT_FIELDS = sorted(ACTConfig.__dataclass_fields__)


def changed(valid: dict[str, Any], names: list[str]) -> st.SearchStrategy[dict[str, Any]]:
    """Return valid data of which some fields are replaced, or of which nothing is left."""
    some = st.dictionaries(st.sampled_from(names) | NAMES, VALUES, max_size=3)
    return some.map(lambda change: {**valid, **change}) | some


def written(data: object) -> bytes:
    """Return JSON as Python writes it, with its NaN, infinities and halves of surrogate pairs."""
    return json.dumps(data).encode()


STEPS = changed(VALID_STEP, ["registry_name", "class", "config", "state_file", "name"])
FILES = {
    CONFIG: changed(VALID_CONFIG, ACT_FIELDS),
    PREPROCESSOR: st.fixed_dictionaries({"steps": st.lists(STEPS, max_size=3) | VALUES}),
    ADAPTER: changed(VALID_ADAPTER, [*VALID_ADAPTER, "base_model_name_or_path", "bias", "megatron_core"]),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A checkpoint as far as reading goes."""
    for name in ("model.safetensors", "state.safetensors"):
        save_file({}, tmp_path / name)
    for name, data in ((CONFIG, VALID_CONFIG), (PREPROCESSOR, {"steps": []})):
        (tmp_path / name).write_bytes(written(data))
    (tmp_path / "policy_postprocessor.json").write_bytes(written({"steps": []}))
    return tmp_path


def read_processor(folder: Path) -> None:
    for step in read_saved_processor(folder / PREPROCESSOR).steps:
        resolve_step(step)
        check_paths(step, step.config, folder)


QUESTIONS: dict[str, tuple[Callable[[Path], object], ...]] = {
    CONFIG: (
        lambda folder: load_policy_recipe(str(folder)),
        lambda folder: read_config(folder, LoadOptions(device="cpu")),
    ),
    PREPROCESSOR: (
        read_processor,
        lambda folder: normalization_notes("lerobot", {"checkpoint": str(folder)}),
    ),
    ADAPTER: (checkpoint_sha256, lambda folder: read_adapter_config(folder / ADAPTER)),
}


@pytest.mark.parametrize("name", [CONFIG, PREPROCESSOR, ADAPTER])
def test_what_is_valid_is_accepted(folder: Path, name: str) -> None:
    valid = {CONFIG: VALID_CONFIG, PREPROCESSOR: {"steps": []}, ADAPTER: VALID_ADAPTER}[name]
    (folder / name).write_bytes(written(valid))
    assert all(accepted_or_refused(lambda ask=ask: ask(folder)) for ask in QUESTIONS[name])


@given(data=st.data())
@pytest.mark.parametrize("name", [CONFIG, PREPROCESSOR, ADAPTER])
def test_other_json_is_accepted_or_refused_with_a_message(folder: Path, name: str, data: Any) -> None:
    (folder / name).write_bytes(written(data.draw(FILES[name] | VALUES)))
    for ask in QUESTIONS[name]:
        accepted_or_refused(lambda ask=ask: ask(folder))


@given(content=st.binary(max_size=64) | st.text(alphabet='{}[]",:0123456789eE.-ntf\\ux', max_size=64))
@pytest.mark.parametrize("name", [CONFIG, PREPROCESSOR, ADAPTER])
def test_other_bytes_are_accepted_or_refused_with_a_message(
    folder: Path, name: str, content: bytes | str
) -> None:
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    for ask in QUESTIONS[name]:
        accepted_or_refused(lambda ask=ask: ask(folder))


with contextlib.suppress(VlaEvalError):
    config_class("none", where="")  # registers all
FAMILIES = sorted(
    kind
    for kind in PreTrainedConfig.get_known_choices()
    if PreTrainedConfig.get_choice_class(kind).__module__.startswith(("lerobot.policies.", "vla_eval."))
)
FEATURES: dict[str, Any] = {
    "input_features": {
        "observation.images.base": {"type": "VISUAL", "shape": [3, 64, 64]},
        "observation.images.wrist": {"type": "VISUAL", "shape": [3, 64, 64]},
        "observation.state": {"type": "STATE", "shape": [10]},
    },
    "output_features": {"action": {"type": "ACTION", "shape": [7]}},
}
INTEGERS = st.sampled_from((-1, 0, 1, 2, 3, 7, 64, 10_000, 2**31, 2**63, 10**30)) | st.integers()
SIZES = st.sampled_from((-1, 0, 1, 2, 3, 7, 64, 2**31, 2**63))
SMALL: dict[str, dict[str, Any]] = {
    "act": {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32},
    "diffusion": {"down_dims": [16, 32], "n_groups": 4},
}
BY_TYPE: dict[type, st.SearchStrategy[Any]] = {
    bool: st.booleans(),
    int: INTEGERS,
    float: st.floats() | INTEGERS,
    str: NASTY | st.text(max_size=8) | st.sampled_from(("resnet", "resnet9", "gemma_1t", "float8", "DDPM")),
    list: st.lists(INTEGERS | NASTY, max_size=4),
    tuple: st.lists(INTEGERS | NASTY, max_size=4),
    dict: st.dictionaries(NAMES, VALUES, max_size=3),
}


def of_its_type(hint: Any, numbers: st.SearchStrategy[Any] | None = None) -> st.SearchStrategy[Any]:
    """Return values that the check of types lets pass, as far as it knows the type."""
    if numbers is not None and hint in (int, float, int | None):
        return numbers
    options = [typing.get_origin(one) or one for one in (hint, *typing.get_args(hint))]
    known = [BY_TYPE[one] for one in options if isinstance(one, type) and one in BY_TYPE]
    return st.one_of(*known) if known else VALUES


@st.composite
def config_of(draw: Any, kind: str, numbers: st.SearchStrategy[Any] | None = None) -> dict[str, Any]:
    """Return a configuration of a family with up to three wrong fields.

    Args:
        draw: of hypothesis.
        kind: of the family.
        numbers: instead of all numbers, those that a network of moderate size can have, or none.
    """
    hints = typing.get_type_hints(PreTrainedConfig.get_choice_class(kind))
    names = [field.name for field in dataclasses.fields(PreTrainedConfig.get_choice_class(kind))]
    some = draw(st.lists(st.sampled_from(names), max_size=3, unique=True))

    def value(name: str) -> Any:
        fitting = of_its_type(hints[name], numbers)
        return draw(fitting if numbers is not None else fitting | VALUES)

    return {"type": kind, **FEATURES, **{name: value(name) for name in some}}


@pytest.mark.sampled(7)
@given(data=st.data())
@pytest.mark.parametrize("kind", FAMILIES)
def test_a_configuration_of_any_family_is_accepted_or_refused(folder: Path, kind: str, data: Any) -> None:
    (folder / CONFIG).write_bytes(written(data.draw(config_of(kind))))
    accepted_or_refused(lambda: read_config(folder, LoadOptions(device="cpu")))


@pytest.mark.sampled(5)
@given(data=st.data())
@pytest.mark.parametrize("kind", ["act", "diffusion", "mikasa_memory", "mikasa_octo", "mikasa_sequence"])
def test_a_network_of_any_configuration_is_built_or_refused(folder: Path, kind: str, data: Any) -> None:
    described = data.draw(config_of(kind, numbers=SIZES))
    (folder / CONFIG).write_bytes(written({**SMALL.get(kind, {}), **described}))

    def build() -> None:
        config = read_config(folder, LoadOptions(device="cpu"))
        with empty_weights():
            make_empty_policy(config)

    accepted_or_refused(build)


for _kind in FAMILIES:
    with contextlib.suppress(ImportError):  # a package that a family needs is not installed
        register_steps(PreTrainedConfig.get_choice_class(_kind))
REGISTERED = sorted(ProcessorStepRegistry.list())


@st.composite
def step_of_any_family(draw: Any) -> dict[str, Any]:
    """Return a registered step with settings of their names, and wrong values."""
    name = draw(st.sampled_from(REGISTERED))
    cls: Any = ProcessorStepRegistry.get(name)
    known = [field.name for field in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []
    names = st.sampled_from(known) | NAMES if known else NAMES
    return {"registry_name": name, "config": draw(st.dictionaries(names, VALUES, max_size=3))}


@given(steps=st.lists(step_of_any_family(), max_size=3))
def test_steps_of_any_family_are_made_or_refused(folder: Path, steps: list[dict[str, Any]]) -> None:
    (folder / PREPROCESSOR).write_bytes(written({"steps": steps}))

    def load() -> None:
        with no_foreign_code("act"):
            load_processor(folder / PREPROCESSOR, overrides={})

    accepted_or_refused(load)
