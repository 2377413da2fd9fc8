"""Text without control characters: what is shown in their place, and what a stream lets through."""

import io
import json
import sys
import unicodedata

import pytest

from vla_eval.plain_text import LINES, PlainStream, printable

CONTROLS = [chr(code) for code in (*range(0x20), 0x7F, *range(0x80, 0xA0))]
BIDI = [chr(code) for code in (*range(0x202A, 0x202F), *range(0x2066, 0x206A), 0x200E, 0x200F, 0x061C)]
SEPARATORS = ["\u2028", "\u2029"]
INVISIBLE = ["\u200b", "\ufeff", "\u00ad", "\U000e0001", "\U000e007f"]
HALVES = ["\ud800", "\udcff"]
SIGNS = "a é ж 漢 ≥ – … █ 🔑 ± × ²"


class Screen(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("letter", CONTROLS + BIDI + SEPARATORS + INVISIBLE + HALVES, ids=ascii)
def test_a_character_that_is_no_sign_is_shown_as_its_escape(letter: str) -> None:
    shown = printable(f"a{letter}b")
    assert shown.isprintable() and shown.isascii() and shown.startswith("a\\") and shown.endswith("b")
    if letter not in HALVES and ord(letter) < 0x10000:
        assert json.loads(f'"{shown}"') == f"a{letter}b"  # in JSON, it is the same text


def test_every_character_of_unicode_is_a_sign_a_space_or_an_escape() -> None:
    for code in range(sys.maxunicode + 1):
        category = unicodedata.category(chr(code))
        is_kept = category[0] in "LMNPS" or category == "Zs"
        assert (printable(chr(code)) == chr(code)) == is_kept, hex(code)


def test_signs_and_spaces_of_all_widths_stay() -> None:
    text = f"{SIGNS}\u00a0\u3000\u202f"
    assert printable(text) == text
    assert printable("a\nb\tc", keep=LINES) == "a\nb\tc"
    assert printable("a\nb\rc\td") == r"a\nb\rc\td"


@pytest.mark.parametrize("kind", [io.StringIO, Screen])
def test_a_stream_writes_no_control_character_in_any_place(kind: type[io.StringIO]) -> None:
    for letter in CONTROLS + BIDI + SEPARATORS + INVISIBLE:
        if letter in LINES:
            continue
        for text in (f"a{letter}b", f"x\n{letter}y\n", f"z{letter}"):
            if letter == "\r" and text.endswith("\n") and kind is Screen:
                continue  # a bar may begin there, at the beginning of a line
            inner = kind()
            stream = PlainStream(inner)
            print("before", text, letter, file=stream)
            stream.writelines(["a", text, letter])
            assert printable(inner.getvalue(), keep=LINES) == inner.getvalue(), ascii(text)
            assert inner.getvalue().startswith("before ")


def test_on_a_terminal_a_bar_goes_back_to_the_beginning_of_its_own_line_alone() -> None:
    screen = Screen()
    stream = PlainStream(screen)
    bar = ["\r 10%|█", "\r 20%|██", "\r       ", "\r"]
    stream.writelines(["start\n", *bar])
    assert screen.getvalue() == "start\n" + "".join(bar)
    stream.writelines(["error: \x1b[2Jx\n", "name", "\rfake", "\r", "\x1b[A", "\n"])
    assert screen.getvalue().removeprefix("start\n" + "".join(bar)) == (
        "error: \\u001b[2Jx\nname\\rfake\\r\\u001b[A\n"
    )


def test_on_a_terminal_a_bar_s_text_is_plain() -> None:
    screen = Screen()
    PlainStream(screen).write("\r 10%|█ task\x1b]0;x\x07\r\x9b2J\u202e")
    assert screen.getvalue() == "\r 10%|█ task\\u001b]0;x\\u0007\\r\\u009b2J\\u202e"


def test_what_a_stream_has_besides_stays() -> None:
    inner = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    stream = PlainStream(inner)
    assert stream.encoding == "utf-8" and stream.buffer is inner.buffer and not stream.isatty()
    assert stream.write("\x1b") == 1
