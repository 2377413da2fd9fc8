"""YAML is read as plain data: whatever a file holds, it is data or one message with its place."""

from typing import Any

import pytest

from vla_eval.errors import RecipeError
from vla_eval.strict.bounds import MAX_DEPTH
from vla_eval.strict.decoding import load_yaml
from vla_eval.strict.yaml_data import MAX_CHARACTERS, MAX_VALUES


def refusal(text: str) -> str:
    with pytest.raises(RecipeError) as caught:
        load_yaml(text, where="configs/x.yaml")
    return str(caught.value)


class TestPlainData:
    @pytest.mark.parametrize(
        ("text", "value"),
        [
            ("", None),
            ("~", None),
            ("null", None),
            ("true", True),
            ("no", False),
            ("-12", -12),
            ("50_000", 50_000),
            ("1.5", 1.5),
            ("-1.0e-3", -0.001),
            ("1e-3", "1e-3"),  # YAML 1.1: a number has a point
            ("'12'", "12"),
            ('"true"', "true"),
            ("|\n  12\n", "12\n"),
            ("[1, [a], {b: 2.0}]", [1, ["a"], {"b": 2.0}]),
            ("\ufeffa: 1\nb: 2\n", {"a": 1, "b": 2}),
            ("a: 1\r\nb: 2\r\n", {"a": 1, "b": 2}),
            ("---\na: 1\n...\n", {"a": 1}),
            ("a: é — 日本", {"a": "é — 日本"}),
        ],
    )
    def test_what_a_recipe_needs_is_read(self, text: str, value: object) -> None:
        found = load_yaml(text, where="x")

        assert found == value
        assert type(found) is type(value)

    @pytest.mark.parametrize(
        "text", ["2024-99-99", "2024-01-01", "2024-01-01 10:00:00", "010", "0x1f", "1:30", "="]
    )
    def test_what_only_yaml_takes_for_a_date_or_a_number_is_text(self, text: str) -> None:
        assert load_yaml(text, where="x") == text

    def test_an_alias_stands_for_a_copy_of_its_own(self) -> None:
        found: Any = load_yaml("a: &x {b: [1]}\nc: *x\n", where="x")
        found["c"]["b"].append(2)

        assert found["a"] == {"b": [1]}


class TestRefused:
    @pytest.mark.parametrize(
        ("text", "place", "said"),
        [
            ("a: !!int x", "line 1, column 4", "tag"),
            ("a: !!timestamp nope", "line 1, column 4", "tag"),
            ("a: !!binary aGk=", "line 1, column 4", "tag"),
            ("a: !!python/object/apply:os.system [ls]", "line 1, column 4", "tag"),
            ("a: ! x", "line 1, column 4", "tag"),
            ("b: 1\na: " + "9" * 5000, "line 2, column 4", "5000 digits"),
            (f"a: {2**63}", "line 1, column 4", "64 bits"),
            ("&e {a: *e}", "line 1, column 8", "itself"),
            ("a: *none", "line 1, column 4", "'*none'"),
            ("[" * 3000 + "]" * 3000, "line 1, column", "nested"),
            ("- " * 3000, "line 1, column", "nested"),
            ("a: 1\n1: 2", "line 2, column 1", "the key 1, expected text"),
            ("true: 2", "line 1, column 1", "the key True, expected text"),
            ("? [a]\n: 2", "line 1, column 3", "expected text"),
            ("{a: 1, a: 2}", "line 1, column 8", "given twice"),
            ("a: 1\n\tb: 2", "line 2, column 1", r"'\t'"),
            ("a: 1\nb: x\0y", "line 2, column 5", "#x0000"),
            ('a: "\\0"', "line 1, column 4", "character"),
            ('a: "\\ud800"', "line 1, column 4", "character"),
            ('a: "\\UFFFFFFFF"', "line 1", ""),
            ("%YAML " + "9" * 5000 + ".1\n---\na", "line 1", ""),
            ("a: 1\n---\nb: 2\n", "line 2, column 1", "one document"),
            ("a: [1\n", "line 2, column 1", "expected"),
        ],
    )
    def test_what_is_not_plain_data_is_refused_with_its_place(self, text: str, place: str, said: str) -> None:
        message = refusal(text)

        assert message.startswith(f"configs/x.yaml: {place}")
        assert said in message
        assert len(message) < 400

    def test_aliases_that_multiply_are_refused_before_they_fill_memory(self) -> None:
        lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
        lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]

        assert f"more than {MAX_VALUES} values" in refusal("\n".join(lines))  # 10^12 without the bound

    def test_aliases_do_not_multiply_a_long_text(self) -> None:
        long = "x" * (MAX_CHARACTERS // 2)

        assert f"more than {MAX_CHARACTERS} characters" in refusal(f"[&a {long}, *a, *a, *a]")

    def test_aliases_do_not_deepen_what_is_nested(self) -> None:
        lines = ["a0: &a0 [x]"] + [f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, MAX_DEPTH + 2)]

        assert "nested" in refusal("\n".join(lines))

    def test_a_huge_file_is_refused_at_once(self) -> None:
        assert f"more than {MAX_CHARACTERS} characters" in refusal("#" * (MAX_CHARACTERS + 1))
