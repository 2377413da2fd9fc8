"""The rooms and the scripts of ViZDoom-Two-Colors.

Made from numbers alone: places, times and amounts as measured in games of griver/memup at d276571, whose map
files have no licence and were not opened. The generator of ZDoom's scripts is drawn from in the same order,
so that a seed gives the vests and the pillar that it gives there.
"""

from dataclasses import dataclass
from typing import NamedTuple

from vla_eval.base_tasks.doom.doom_wad import (
    Code,
    Jump,
    Label,
    Op,
    Script,
    Special,
    When,
    behavior,
    fixed,
    push,
    special,
    text_map,
    wad,
)

MAP = "MAP01"
LOW, HIGH = -768, 512  # where the walls of the acid room are, in both directions
DRAWN = (fixed(LOW), fixed(HIGH - 1))  # between these a place is drawn, again if nothing fits there
ACID_OUTLINE = (
    (LOW, LOW),
    (LOW, HIGH),
    (HIGH, HIGH),
    (HIGH, -504),
    (256, -504),  # a block stands out of the eastern wall
    (256, -520),
    (HIGH, -520),
    (HIGH, LOW),
)
HEIGHT = 128
WAITING_ROOM = ((-1568, -128), (-1568, 128), (-864, 128), (-864, -128))
CHOICE_ROOM = ((576, -128), (576, 128), (1024, 128), (1024, -128))
CHOICE_VESTS = {False: (928, 64), True: (928, -64)}  # is_red -> place
ACID_START, CHOICE_START = (-128, -128), (672, 0)  # of Delay1000
WAITING_TICS, MEDIKIT_TICS, ACID_TICS = 100, 50, 2000
PILLAR_TICS, VEST_TICS = 90, 30
N_OF_EACH = 10
HEAL = DAMAGE = 25
SHAPING, IS_RED, CHOICE = 1, 2, 3
"""Global variables, which ViZDoom shows as USER1 to USER3."""
RIGHT, WRONG = 1, 2
"""Values of CHOICE; 0 before it."""
MEDIKIT_TAKEN, VEST_CHOSEN = 4, 5
VEST_TAKEN = {False: 2, True: 3}
"""Numbers of scripts that pick-ups execute; one that is under way is not begun again."""
PILLAR_TID, MEDIKIT_TID = 1, 4
VEST_TID = {False: 2, True: 3}
PLAYER_START, GREEN_ARMOR, BLUE_ARMOR = 1, 2018, 2019  # numbers of things in a map

CLASSES = ("GreenArmor", "BlueArmor", "TallGreenColumn", "TallRedColumn", "Medikit")
"""Strings of the scripts. "Red" is Doom's blue armour, which Freedoom draws red."""
VEST, PILLAR = {False: 0, True: 1}, {False: 2, True: 3}
MEDIKIT = 4


Outline = tuple[tuple[int, int], ...]
"""Corners of a room, clockwise."""
Block = tuple[str, dict[str, object]]
"""What `text_map` writes."""


class Look(NamedTuple):
    """Textures, light and effect of a room."""

    wall: str
    floor: str
    ceiling: str
    light: int
    special: int = 0


ACID_LOOK = Look("STONE2", "NUKAGE1", "CEIL4_1", 160, special=83)  # 8 health every 32 tics
DRY_LOOK = Look("STARGR1", "FLOOR5_1", "CEIL3_5", 192)


class Pose(NamedTuple):
    """Where the player begins."""

    x: int
    y: int
    degrees: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """One of the three games.

    Attributes:
        start: of the player.
        pillar: where the pillar stands.
        is_delayed: whether the choice comes at the end, in a room of its own.
        living_reward: for each tic.
    """

    start: Pose
    pillar: tuple[int, int]
    is_delayed: bool = False
    living_reward: float = 0.01


LEVELS = {
    "base": Level(start=Pose(-384, -640, 45), pillar=(-256, -512)),
    "hard": Level(start=Pose(-384, -640, 0), pillar=(-128, -128)),
    "delay1000": Level(start=Pose(-1440, 0, 0), pillar=(-1120, 0), is_delayed=True, living_reward=0.0),
}


def map_file(level: Level) -> bytes:
    """Return the WAD of a level. It has no nodes: ZDoom builds them."""
    scripts = _delayed_scripts(level) if level.is_delayed else _scripts(level)
    lumps = (("TEXTMAP", _text(level)), ("BEHAVIOR", behavior(scripts, CLASSES)), ("ENDMAP", b""))
    return wad([(MAP, b""), *lumps])


def _text(level: Level) -> bytes:
    blocks = _room(ACID_OUTLINE, ACID_LOOK, sector=0, first=0)
    blocks += [_thing(PLAYER_START, level.start)]
    if level.is_delayed:
        n_corners = len(ACID_OUTLINE)
        for sector, outline in enumerate((WAITING_ROOM, CHOICE_ROOM), 1):
            blocks += _room(outline, DRY_LOOK, sector=sector, first=n_corners)
            n_corners += len(outline)
        for is_red, (x, y) in CHOICE_VESTS.items():
            kind = BLUE_ARMOR if is_red else GREEN_ARMOR
            executes = {"special": Special.ACS_EXECUTE.value, "arg0": VEST_CHOSEN, "arg2": int(is_red)}
            blocks += [_thing(kind, Pose(x, y, 0), **executes)]
    return text_map(blocks)


def _room(outline: Outline, look: Look, *, sector: int, first: int) -> list[Block]:
    """Return a room; `first`: how many corners, and so lines, there are before it."""
    blocks: list[Block] = []
    for k, (x, y) in enumerate(outline):
        v1, v2 = first + k, first + (k + 1) % len(outline)
        blocks.append(("vertex", {"x": float(x), "y": float(y)}))
        blocks.append(("linedef", {"v1": v1, "v2": v2, "sidefront": v1, "blocking": True}))
        blocks.append(("sidedef", {"sector": sector, "texturemiddle": look.wall}))
    surfaces = {"texturefloor": look.floor, "textureceiling": look.ceiling, "lightlevel": look.light}
    heights = {"heightfloor": 0, "heightceiling": HEIGHT}
    return [*blocks, ("sector", {**heights, **surfaces, "special": look.special})]


def _thing(kind: int, pose: Pose, **executes: int) -> Block:
    place = {"x": float(pose.x), "y": float(pose.y), "angle": pose.degrees, "type": kind}
    skills = {f"skill{k}": True for k in range(1, 6)}
    return "thing", {**place, **skills, "single": True, **executes}


def _scripts(level: Level) -> list[Script]:
    first: list[int | Label | Jump] = [*_pillar(level)]
    for k in range(N_OF_EACH):
        for is_red in (False, True):
            first += _placed(
                VEST[is_red], VEST_TID[is_red], VEST_TAKEN[is_red], int(is_red), name=f"first {k} {is_red}"
            )
    again = Label("again")
    first += [*push(PILLAR_TICS), Op.DELAY, *special(Special.THING_REMOVE, PILLAR_TID), again]
    for is_red in (False, True):
        first += _placed(
            VEST[is_red], VEST_TID[is_red], VEST_TAKEN[is_red], int(is_red), name=f"more {is_red}"
        )
        first += [*push(VEST_TICS), Op.DELAY]
    return [
        Script(1, When.OPEN, 0, [*first, Jump(Op.GOTO, again)]),
        *(Script(VEST_TAKEN[is_red], When.CALLED, 1, _vest_taken()) for is_red in (False, True)),
    ]


def _delayed_scripts(level: Level) -> list[Script]:
    first: list[int | Label | Jump] = [*_pillar(level)]
    for k in range(2 * N_OF_EACH):
        first += _placed(MEDIKIT, MEDIKIT_TID, MEDIKIT_TAKEN, 0, name=f"first {k}")
    again = Label("again")
    first += [*push(WAITING_TICS), Op.DELAY, again]
    first += _placed(MEDIKIT, MEDIKIT_TID, MEDIKIT_TAKEN, 0, name="more")
    first += [*push(MEDIKIT_TICS), Op.DELAY]
    moves = [*push(WAITING_TICS), Op.DELAY, *_moved(ACID_START)]
    moves += [*push(ACID_TICS), Op.DELAY, *_moved(CHOICE_START), Op.TERMINATE]
    taken = [*push(fixed(0.1)), Op.ADD_GLOBAL, SHAPING, Op.TERMINATE]
    return [
        Script(1, When.OPEN, 0, [*first, Jump(Op.GOTO, again)]),
        Script(6, When.ENTER, 0, moves),
        Script(MEDIKIT_TAKEN, When.CALLED, 0, taken),
        Script(VEST_CHOSEN, When.CALLED, 1, _vest_chosen()),
    ]


def _pillar(level: Level) -> Code:
    """Draw the colour and place its pillar."""
    x, y = (fixed(number) for number in level.pillar)
    red, done = Label("red"), Label("pillar stands")
    code: list[int | Label | Jump] = [*push(0), Op.ASSIGN_GLOBAL, SHAPING, *push(0), Op.ASSIGN_GLOBAL, CHOICE]
    code += [*push(0, 1), Op.RANDOM, Op.ASSIGN_GLOBAL, IS_RED, Op.PUSH_GLOBAL, IS_RED, Jump(Op.IF_GOTO, red)]
    code += [*push(PILLAR[False], x, y, 0, PILLAR_TID, 0), Op.SPAWN, Op.DROP, Jump(Op.GOTO, done)]
    code += [red, *push(PILLAR[True], x, y, 0, PILLAR_TID, 0), Op.SPAWN, Op.DROP, done]
    return code


def _placed(what: int, tid: int, script: int, argument: int, *, name: str) -> Code:
    """Place one thing where it fits; taking it executes a script."""
    retry = Label(name)
    code: list[int | Label | Jump] = [retry, *push(what)]
    code += 2 * [*push(*DRAWN), Op.RANDOM]
    code += [*push(0, tid, 0), Op.SPAWN, Jump(Op.IF_NOT_GOTO, retry)]
    code += [*push(tid, Special.ACS_EXECUTE, script, 0, argument, 0, 0), Op.SET_THING_SPECIAL]
    return code


def _vest_taken() -> Code:
    """Heal for the pillar's colour, else hurt; the vest itself protects from this damage, then is lost."""
    wrong, done = Label("wrong"), Label("done")
    code: list[int | Label | Jump] = [Op.PUSH_SCRIPT, 0, Op.PUSH_GLOBAL, IS_RED, Op.EQUAL]
    code += [Jump(Op.IF_NOT_GOTO, wrong), *special(Special.HEAL_THING, HEAL)]
    code += [*push(fixed(1.0)), Op.ADD_GLOBAL, SHAPING, Jump(Op.GOTO, done)]
    code += [wrong, *special(Special.DAMAGE_THING, DAMAGE), *push(fixed(-1.0)), Op.ADD_GLOBAL, SHAPING]
    code += [done, Op.CLEAR_INVENTORY, Op.TERMINATE]
    return code


def _vest_chosen() -> Code:
    wrong = Label("wrong")
    code: list[int | Label | Jump] = [Op.PUSH_SCRIPT, 0, Op.PUSH_GLOBAL, IS_RED, Op.EQUAL]
    code += [Jump(Op.IF_NOT_GOTO, wrong), *push(fixed(5.0)), Op.ADD_GLOBAL, SHAPING]
    code += [*push(RIGHT), Op.ASSIGN_GLOBAL, CHOICE, Op.TERMINATE]
    code += [wrong, *push(WRONG), Op.ASSIGN_GLOBAL, CHOICE, Op.TERMINATE]
    return code


def _moved(place: tuple[int, int]) -> Code:
    """Put the player elsewhere, at rest, facing east."""
    x, y = (fixed(number) for number in place)
    code = [*push(0, x, y, 0, 0), Op.SET_ACTOR_POSITION, Op.DROP, *push(0, 0), Op.SET_ACTOR_ANGLE]
    return [*code, *special(Special.THING_STOP, 0)]
