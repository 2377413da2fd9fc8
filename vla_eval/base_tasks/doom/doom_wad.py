"""Write maps for ZDoom without its tools: a WAD with a UDMF text map and compiled ACS scripts.

Formats: UDMF 1.1 in the namespace `zdoom`; the old ACS object, of which ZDoom reads every opcode as 32 bits.
Opcodes and line specials are numbered as in ZDoom's `p_acs.h` and `actionspecials.h`. Knows no game.
"""

import itertools
import struct
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple

FIXED_ONE = 1 << 16
"""1.0 in ACS, which has only whole numbers."""
HEADER_BYTES, WORD_BYTES = 8, 4
TYPE_STEP = 1000  # the directory has a script's type and number in one


class Op(IntEnum):
    """Opcodes; their operands come from the stack where nothing else is said."""

    TERMINATE = 1
    PUSH = 3  # the number follows
    SPECIAL_1 = 4  # the special's number follows; the next opcodes are those for more arguments
    EQUAL = 19
    ASSIGN_SCRIPT = 25  # the variable's number follows, for all of these
    PUSH_SCRIPT = 28
    ADD_SCRIPT = 31
    GOTO = 52  # where to follows
    IF_GOTO = 53
    DROP = 54
    DELAY = 55
    RANDOM = 57
    IF_NOT_GOTO = 79
    CLEAR_INVENTORY = 142
    SPAWN = 149  # class, x, y, z, tid, byte angle -> how many
    SET_THING_SPECIAL = 180  # tid, special, five arguments
    ASSIGN_GLOBAL = 181
    PUSH_GLOBAL = 182
    ADD_GLOBAL = 183
    SET_ACTOR_ANGLE = 276  # tid, angle
    SET_ACTOR_POSITION = 283  # tid, x, y, z, fog -> whether it fits


class Special(IntEnum):
    """Line specials, which scripts and pick-ups execute."""

    THING_STOP = 19
    DAMAGE_THING = 73
    ACS_EXECUTE = 80
    THING_REMOVE = 132
    HEAL_THING = 248


class When(IntEnum):
    """What starts a script: `ACS_EXECUTE`, the level, a player who enters it."""

    CALLED = 0
    OPEN = 1
    ENTER = 4


class Label(NamedTuple):
    """A place in the code."""

    name: str


class Jump(NamedTuple):
    """GOTO, IF_GOTO or IF_NOT_GOTO with where it goes."""

    op: Op
    label: Label


Code = Sequence[int | Label | Jump]
"""Opcodes and the words that follow them."""


class Script(NamedTuple):
    """One script; its arguments are its first variables."""

    number: int
    when: When
    n_arguments: int
    code: Code


def fixed(number: float) -> int:
    """Return a number as ACS has it; its compiler cuts off what is smaller."""
    return int(number * FIXED_ONE)


def push(*numbers: int) -> list[int]:
    """Return code that pushes constants."""
    return list(itertools.chain.from_iterable((Op.PUSH, number) for number in numbers))


def special(number: Special, *arguments: int) -> list[int]:
    """Return code that executes a line special with constants."""
    return [*push(*arguments), Op.SPECIAL_1 + len(arguments) - 1, number]


def behavior(scripts: Sequence[Script], strings: Sequence[str]) -> bytes:
    """Return the lump BEHAVIOR: code, strings, the directory of both."""
    body = b""
    starts: list[int] = []
    for script in scripts:
        starts.append(HEADER_BYTES + len(body))
        body += _assembled(script.code, starts[-1])
    places: list[int] = []
    for string in strings:
        places.append(HEADER_BYTES + len(body))
        body += string.encode("ascii") + b"\0"
    body += b"\0" * (-len(body) % WORD_BYTES)
    directory = _words([len(scripts)])
    for script, start in zip(scripts, starts, strict=True):
        directory += _words([TYPE_STEP * script.when + script.number, start, script.n_arguments])
    directory += _words([len(strings), *places])
    return b"ACS\0" + _words([HEADER_BYTES + len(body)]) + body + directory


def _assembled(code: Code, start: int) -> bytes:
    """Return the words of a script; jumps go to offsets within the lump."""
    places: dict[Label, int] = {}
    words: list[int | Label] = []
    for item in code:
        if isinstance(item, Label):
            places[item] = start + WORD_BYTES * len(words)
        elif isinstance(item, Jump):
            words += (item.op, item.label)
        else:
            words.append(item)
    return _words([places[word] if isinstance(word, Label) else word for word in words])


def _words(numbers: Iterable[int]) -> bytes:
    return b"".join(struct.pack("<I", number & 0xFFFFFFFF) for number in numbers)


def text_map(blocks: Iterable[tuple[str, dict[str, object]]]) -> bytes:
    """Return the lump TEXTMAP of (kind, fields) blocks, in their order: they are numbered by it."""
    text = 'namespace = "zdoom";\n'
    for kind, fields in blocks:
        lines = "".join(f"{name} = {_value(value)};\n" for name, value in fields.items())
        text += f"{kind}\n{{\n{lines}}}\n"
    return text.encode("ascii")


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)


def wad(lumps: Iterable[tuple[str, bytes]]) -> bytes:
    """Return a patch WAD with lumps in their order."""
    data, directory, n_lumps = b"", b"", 0
    for name, lump in lumps:
        directory += struct.pack("<ii8s", 12 + len(data), len(lump), name.encode("ascii"))
        data += lump
        n_lumps += 1
    return struct.pack("<4sii", b"PWAD", n_lumps, 12 + len(data)) + data + directory
