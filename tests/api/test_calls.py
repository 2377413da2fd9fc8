"""Every public function: an argument of another type, or one too many, is answered by this package."""

import inspect
import pickle
from collections.abc import Iterator
from typing import Any

import pytest

import vla_eval
from vla_eval.api.probing import ProbeResult
from vla_eval.errors import RecipeError
from vla_eval.strict.calls import public

FUNCTIONS = [getattr(vla_eval, name) for name in vla_eval._PLACES if name != "Run"]
METHODS = [vla_eval.Run.table, vla_eval.Run.to_pandas, vla_eval.Run.compare, vla_eval.Run.page]
ALL = [*FUNCTIONS, *METHODS, ProbeResult.table]


class Nothing:
    """Nothing that any argument can be."""


def arguments() -> Iterator[Any]:
    for function in ALL:
        for name, parameter in inspect.signature(function).parameters.items():
            is_any = parameter.annotation in (Any, inspect.Parameter.empty)
            if not is_any and parameter.kind is not parameter.VAR_KEYWORD:
                yield pytest.param(function, name, id=f"{function.__qualname__}-{name}")


@pytest.mark.parametrize(("function", "name"), list(arguments()))
def test_an_argument_of_another_type_is_named(function: Any, name: str) -> None:
    parameters = inspect.signature(function).parameters
    given = {
        one: Nothing() if one == name else parameter.annotation()
        for one, parameter in parameters.items()
        if one == name or (parameter.default is parameter.empty and parameter.annotation is str)
    }
    positional = [
        object() for one in parameters if one == "self" or (one in ("policy",) and len(parameters) == 2)
    ]
    if parameters[name].kind is inspect.Parameter.VAR_POSITIONAL:
        positional, given = [Nothing()], {}
    with pytest.raises(RecipeError, match=f"{function.__qualname__}: {name}: expected .*, found <"):
        function(*positional, **given)


@pytest.mark.parametrize("function", ALL, ids=lambda function: function.__qualname__)
def test_too_many_arguments_are_answered_with_those_that_there_are(function: Any) -> None:
    if function is vla_eval.load_run:
        pytest.skip("takes any number")
    with pytest.raises(RecipeError, match=r"too many positional arguments\. Expected "):
        function(*["x"] * 9)


def test_a_public_function_is_pickled_by_its_name_and_keeps_its_signature() -> None:
    for function in FUNCTIONS:
        assert pickle.loads(pickle.dumps(function)) is function
        assert function.__doc__ and not function.__doc__.startswith("Compare")


@public
def example(folder: str, *, count: int = 1, share: float = 0.5, is_on: bool = True) -> object:
    """Return what it was given."""
    return folder, count, share, is_on


@pytest.mark.parametrize(
    "given", [{"count": True}, {"share": True}, {"is_on": 1}, {"count": 1.5}, {"folder": 1}]
)
def test_a_truth_value_is_no_number_and_a_number_no_truth_value(given: dict[str, Any]) -> None:
    with pytest.raises(RecipeError, match=f"example: {next(iter(given))}: expected"):
        example(**{"folder": "x", **given})


def test_what_fits_is_passed_on() -> None:
    import numpy as np

    assert example("x", count=np.int64(2), share=np.float32(1), is_on=False) == ("x", 2, 1.0, False)
