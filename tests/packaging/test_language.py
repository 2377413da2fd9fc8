"""The text is in the standard terms of the field: a table of words to avoid, and what to say instead.

It reads the Markdown files, the notebooks, the comments of YAML, shell and Make files, and the comments,
docstrings and messages of the Python files. Names of the code, which stand in `backticks`, may be anything.
"""

import ast
import io
import json
import re
import subprocess
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]

RECIPES = ("configs", "datasets", "policies", "prompts", "protocols")
"""Their YAML files are not read: a digest of their bytes stands in every `run.json`, comments included."""

SAY_INSTEAD = {
    r"pictures?": "image, frame",
    r"eyes?(?!-in-hand)": "vision encoder, camera",
    r"laws?": "controller, rule",
    r"telling": "predicting, showing",
    r"(told|tells?|telling)( \w+){0,3} apart": "distinguish",
    r"(is|are|was|be) told (from|by)": "differs from, follows from",
    r"told (nothing|what|where|how)|(is|are|was|be) (never |not )?told": "gets, is given, is not stated",
    r"(take|takes|took|taken|taking) down": "log, record",
    r"bears?|borne": "support, have",
    r"farewells?": "last message",
    r"last words?": "last output",
    r"hopeless(ly)?": "cannot succeed",
    r"anew": "again, from scratch, newly",
    r"(plays?|played|playing)": "run, execute",
    r"do(es|ne)? (it|them|that) again": "reproduce, run again",
    r"(what|whatever) (came|comes|becomes|became) of": "outcome, result",
    r"nobody['’]s|own affair": "not checked here",
    r"(come|comes|came) to grief": "fail",
    r"(mend|mends|mended|mending)": "fix",
    r"(go|goes|going|gone|went) on(?! top)": "resume, continue",
    r"slips? of the pen": "typo",
    r"processor time": "CPU time",
    r"(speak|speaks|spoke|spoken) of": "describe, cover",
    r"one['’]s own": "your own",
    r"roads?": "shortcut, way",
    r"wonders?": "surprising",
    r"beside other (work|load|things)": "with other load",
    r"(?<!there )(?<!where )(is|are|was|were) no (?!longer|more|less|one|evidence|proof)": "is not a …",
    r"(says?|said) of (itself|themselves|its|it|them)": "reports, states, metadata",
    r"(is|are|was) known of": "is known about",
    r"whence": "from where",
    r"so that not": "…, so not all …",
    r"whoever": "anyone who, code that",
    r"(tell|tells) (whether|which \w+ from|\w+ from)": "distinguish, show",
}

ALLOWED = (
    "law of succession",  # Wilson's title
    "Scaling laws",  # Kaplan's title
    "plays in a browser",  # a video
    "browser plays",
    "plays a part",
)

FORBIDDEN = {
    re.compile(rf"(?<![\w-]){word}(?![\w-])", re.IGNORECASE): say for word, say in SAY_INSTEAD.items()
}
BACKTICKS = re.compile(r"`[^`\n]*`")
FIELD = re.compile(r"^\s+\*{0,2}\w+(?:(?:, | / )\*{0,2}\w+)*:(?=\s|$)")
"""The names before a colon in a docstring's list of attributes or arguments: no sentence begins like this."""


class Line(NamedTuple):
    """A line of text that people read."""

    path: str
    number: int
    text: str


def offences(line: Line) -> list[str]:
    """Return a message for each word to avoid."""
    text = BACKTICKS.sub(" ", line.text)
    for phrase in ALLOWED:
        text = text.replace(phrase, " ")
    return [
        f"{line.path}:{line.number}: '{found.group()}': say {say}"
        for pattern, say in FORBIDDEN.items()
        for found in pattern.finditer(text)
    ]


def words_of_python(path: str, source: str) -> Iterator[Line]:
    """Yield comments, docstrings and messages; a string without a space is a name."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield Line(path, token.start[0], token.string)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value.strip():
            for offset, text in enumerate(node.value.splitlines()):
                yield Line(path, node.lineno + offset, FIELD.sub("", text) if offset else text)


def words_of_comments(path: str, source: str) -> Iterator[Line]:
    """Yield what follows a `#` at the beginning of a line or behind a space."""
    for number, text in enumerate(source.splitlines(), 1):
        _, hash_sign, comment = f" {text}".partition(" #")
        if hash_sign:
            yield Line(path, number, comment)


def words_of_prose(path: str, source: str) -> Iterator[Line]:
    """Yield every line."""
    for number, text in enumerate(source.splitlines(), 1):
        yield Line(path, number, text)


def words_of_notebook(path: str, source: str) -> Iterator[Line]:
    """Yield what its cells say, without their outputs; the number is that of the cell."""
    for number, cell in enumerate(json.loads(source)["cells"], 1):
        words = words_of_prose if cell["cell_type"] == "markdown" else words_of_python
        yield from (line._replace(number=number) for line in words(path, "".join(cell["source"])))


def words_of(path: str) -> Iterator[Line]:
    """Yield what people read in a file."""
    source = (ROOT / path).read_text(encoding="utf-8")
    if path.endswith(".py"):
        yield from words_of_python(path, source)
    elif path.endswith((".md", ".j2")):
        yield from words_of_prose(path, source)
    elif path.endswith(".ipynb"):
        yield from words_of_notebook(path, source)
    else:
        yield from words_of_comments(path, source)


def files_to_read() -> list[str]:
    """Return the tracked files whose text is ours, without tests and what is exempt."""
    patterns = ("*.md", "*.ipynb", "*.j2", "*.yml", "*.yaml", "*.py", "*.sh", "*.toml", "Makefile")
    listed = subprocess.run(
        ["git", "ls-files", "--", *patterns], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [
        path
        for path in listed.stdout.splitlines()
        if not path.startswith("tests/") and not (path.startswith(RECIPES) and path.endswith(".yaml"))
    ]


def test_the_text_is_in_the_terms_of_the_field() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout")
    found = [message for path in files_to_read() for line in words_of(path) for message in offences(line)]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("two pictures per step", "pictures"),
        ("The run goes on.", "goes on"),
        ("a policy is told from its twin", "is told from"),
        ("Anew", "Anew"),
    ],
)
def test_a_word_to_avoid_is_named_with_its_line(text: str, word: str) -> None:
    messages = offences(Line("docs/page.md", 7, text))
    assert any(message.startswith(f"docs/page.md:7: '{word}': say ") for message in messages)


@pytest.mark.parametrize(
    "text",
    ["`pictures` is a field", "Flags go on top of it.", "an eye-in-hand camera", "the law of succession"],
)
def test_names_terms_and_titles_are_no_offence(text: str) -> None:
    assert offences(Line("docs/page.md", 1, text)) == []


def test_docstrings_comments_and_messages_of_python_are_read() -> None:
    source = '"""First.\n\nA picture."""\nkey = "pictures"\nmessage = f"{key} of eyes"  # anew\n'
    found = [(line.number, line.text) for line in words_of_python("a.py", source)]
    assert (3, "A picture.") in found and (5, " of eyes") in found and (5, "# anew") in found
    assert "pictures" not in [text for _, text in found]


def test_a_sentence_before_a_colon_is_read_and_a_name_is_not() -> None:
    docstring = '"""Do it.\n\nWhoever asks: nobody.\n    whoever: a name.\n    first, whoever: two.\n"""\n'
    found = [offence for line in words_of_python("x.py", docstring) for offence in offences(line)]
    assert found == ["x.py:3: 'Whoever': say anyone who, code that"]


def test_text_and_code_of_notebooks_are_read_and_outputs_are_not() -> None:
    text = {"cell_type": "markdown", "source": ["Two pictures."]}
    code = {"cell_type": "code", "source": ["x = 1  # anew\n"], "outputs": [{"text": ["eyes"]}]}
    lines = words_of_notebook("x.ipynb", json.dumps({"cells": [text, code]}))
    found = [offence for line in lines for offence in offences(line)]
    assert [one.partition(": say")[0] for one in found] == ["x.ipynb:1: 'pictures'", "x.ipynb:2: 'anew'"]
