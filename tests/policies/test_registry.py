"""Adapters are found by name, by module and attribute, and by entry point."""

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from vla_eval.errors import MissingDependencyError, UnknownNameError
from vla_eval.policies import registry
from vla_eval.policies.registry import check_adapter, policy_adapters, policy_factory


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "their_policies.py").write_text("def make(context): return context\nmake_not = 3\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "their_policies", raising=False)
    return "their_policies"


def test_every_adapter_of_ours_can_be_made() -> None:
    assert {"random", "hold", "oracle", "cue_blind", "tour"} <= set(policy_adapters())
    for name in registry.POLICIES:
        assert callable(policy_factory(name))


def test_module_and_attribute_name_an_adapter(module: str) -> None:
    check_adapter(f"{module}:make")

    assert policy_factory(f"{module}:make").__module__ == module


def test_entry_points_of_other_packages_are_adapters(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint(name="theirs", value=f"{module}:make", group=registry.POLICY_GROUP)
    ours = EntryPoint(name="random", value=f"{module}:make", group=registry.POLICY_GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: (point, ours))

    assert policy_factory("theirs").__module__ == module
    assert policy_factory("random").__module__ == "vla_eval.policies.controls.scripted"


def test_an_unknown_adapter_is_refused_with_the_closest_name() -> None:
    for find in (check_adapter, policy_factory):
        with pytest.raises(UnknownNameError, match=r"no policy adapter 'orakle'. Did you mean 'oracle'"):
            find("orakle")


def test_an_unknown_module_is_refused() -> None:
    for find in (check_adapter, policy_factory):
        with pytest.raises(UnknownNameError, match=r"there is no module 'no_such_module'.*PYTHONPATH"):
            find("no_such_module:make")


def test_an_unknown_attribute_is_refused_with_the_closest_name(module: str) -> None:
    with pytest.raises(UnknownNameError, match=r"has no 'mak'. Did you mean 'make"):
        policy_factory(f"{module}:mak")


def test_what_is_no_function_is_refused(module: str) -> None:
    with pytest.raises(UnknownNameError, match="3 is not a function"):
        policy_factory(f"{module}:make_not")


@pytest.mark.parametrize("adapter", ["a:", ":b"])
def test_half_a_target_is_refused(adapter: str) -> None:
    with pytest.raises(UnknownNameError, match="expected 'module:attribute'"):
        check_adapter(adapter)


@pytest.mark.parametrize(
    "adapter",
    [
        "__main__:x",
        "os:system",
        "os.path:join",
        "builtins:exec",
        "subprocess:run",
        "sys:exit",
        "_io:open",
    ],
)
def test_python_itself_holds_no_adapter(adapter: str) -> None:
    for find in (check_adapter, policy_factory):
        with pytest.raises(UnknownNameError, match="module of Python itself"):
            find(adapter)


@pytest.mark.parametrize("adapter", ["vla_eval:x", "vla_eval.cli.main:main", "vla_eval.policies:x"])
def test_the_rest_of_this_package_holds_no_adapter(adapter: str) -> None:
    for find in (check_adapter, policy_factory):
        with pytest.raises(UnknownNameError, match="module of this package and holds no policies"):
            find(adapter)


@pytest.mark.parametrize(
    "adapter", ["a b:c", "a/b:c", "../a:c", "a..b:c", ".a:c", "a:b:c", "a:b()", "a:\n", "1:2"]
)
def test_what_is_no_module_and_attribute_is_refused(adapter: str) -> None:
    for find in (check_adapter, policy_factory):
        with pytest.raises(UnknownNameError, match="expected 'module:attribute'"):
            find(adapter)


def test_what_takes_no_context_is_refused_and_not_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "odd_policies.py").write_text(
        "called = []\n"
        "def make(): called.append(1)\n"
        "def named(*, context): called.append(1)\n"
        "class Empty: ...\n"
        "class Callable:\n    def __call__(self, context): called.append(1)\n"
        "thing = Callable()\n"
        "class Policy:\n    def __init__(self, context): ...\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("make", "named", "Empty", "thing"):
        with pytest.raises(UnknownNameError, match="is not a function that makes a policy"):
            policy_factory(f"odd_policies:{name}")

    assert policy_factory("odd_policies:Policy").__name__ == "Policy"
    assert sys.modules["odd_policies"].called == []


def test_a_missing_package_of_an_adapter_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "needy.py").write_text("import no_such_package\n")
    monkeypatch.syspath_prepend(tmp_path)

    with pytest.raises(MissingDependencyError, match="needs the package 'no_such_package'"):
        policy_factory("needy:make")


def test_checking_an_adapter_imports_nothing(module: str) -> None:
    check_adapter(f"{module}:make")

    assert module not in sys.modules
