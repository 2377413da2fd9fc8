"""The levels of the environments with images, one row each."""

from collections.abc import Iterator

from vla_eval.base_tasks.row import BaseTask, Figures

PLAYERS = "vla_eval.base_tasks.players"
_ENDLESS = "MarcoMeter/endless-memory-gym at a94f2b6 (MIT)"


def image_rows() -> Iterator[BaseTask]:
    """Yield the rows of all families."""
    yield from _minigrid()
    yield from _ballet()
    yield _visual_match()
    yield _mortar_mayhem()
    yield _mystery_path()
    yield from _two_colors()
    yield from _memory_maze()


def _minigrid() -> Iterator[BaseTask]:
    # The official package's S17Random has side 19; so it has here.
    rows = (
        ("S7", 7, False, 0.25, 0.49, 0.984),
        ("S13", 13, False, 0.21, 0.49, 0.992),
        ("S13Random", 13, True, 0.25, 0.49, 0.993),
        ("S17Random", 19, True, 0.17, 0.49, 0.996),
        ("S19", 19, False, 0.22, 0.49, 0.995),
    )
    for name, size, random_length, random, memoryless, best in rows:
        yield BaseTask(
            name=f"MiniGrid-Memory{name}-v0",
            family="MiniGrid-Memory",
            entry_point="vla_eval.base_tasks.minigrid_memory:MiniGridMemoryEnv",
            kwargs={"size": size, "random_length": random_length},
            horizon_steps=5 * size**2,
            memory=("object",),
            tier="complex image",
            extra="base",
            description="Walk to the object that lay in the first room.",
            remember="1 bit for the length of the hallway",
            success="The agent stands at the right object.",
            figures=Figures(
                random=random, memoryless=memoryless, best=best, source="measured; best: shortest path"
            ),
            memoryless=f"{PLAYERS}.minigrid:TurnsLeft",
            oracle=f"{PLAYERS}.minigrid:Oracle",
            source="Farama-Foundation/Minigrid at 9092872, release 3.2.0 (Apache-2.0)",
        )


def _ballet() -> Iterator[BaseTask]:
    rows = (
        ("Easy", 2, 16, False, 320, 0.43),
        ("Medium", 4, 16, False, 320, 0.23),
        ("Hard", 8, 48, False, 1024, 0.08),
        ("LightEasy", 2, 16, True, 320, 0.43),
    )
    for level, n_dancers, delay_steps, is_light, horizon_steps, random in rows:
        yield BaseTask(
            name=f"Ballet{level}-v0",
            family="Ballet",
            entry_point="vla_eval.base_tasks.ballet:BalletEnv",
            kwargs={"n_dancers": n_dancers, "delay_steps": delay_steps, "is_light": is_light},
            horizon_steps=horizon_steps,
            memory=("sequential", "object"),
            tier="complex image",
            description="Watch dancers, then walk to the one whose dance is named.",
            remember=f"{n_dancers} dances for up to {n_dancers * (15 + delay_steps)} frames",
            success="The agent comes to the right dancer.",
            figures=Figures(
                random=random, memoryless=1 / n_dancers, best=1.0, source="random: measured; others: exact"
            ),
            memoryless=f"{PLAYERS}.ballet:AnyDancer",
            oracle=f"{PLAYERS}.ballet:Oracle",
            source="jinPrelude/gym-balletenv at e28b56e (Apache-2.0), after Lampinen et al. 2021",
        )


def _visual_match() -> BaseTask:
    return BaseTask(
        name="Passive-VisualMatch-v0",
        family="VisualMatch",
        entry_point="vla_eval.base_tasks.visual_match:VisualMatchEnv",
        horizon_steps=60,
        memory=("object",),
        tier="complex image",
        description="See a colour, gather apples, step onto the pad of that colour.",
        remember="one of 3 colours for 30 steps",
        success="The first pad stepped on has the colour.",
        figures=Figures(random=3.3, memoryless=12.0, best=20.6, source="measured over 100 episodes"),
        memoryless=f"{PLAYERS}.visual_match:NearestInView",
        oracle=f"{PLAYERS}.visual_match:Oracle",
        source="twni2016/Memory-RL at c9b8b39 (Apache-2.0), after Hung et al. 2019",
    )


def _mortar_mayhem() -> BaseTask:
    return BaseTask(
        name="MortarMayhem-v0",
        family="MortarMayhem",
        entry_point="vla_eval.base_tasks.mortar_mayhem:MortarMayhemEnv",
        horizon_steps=274,
        memory=("capacity", "sequential"),
        tier="complex image",
        extra="base",
        description="See ten commands, then carry them out in time.",
        remember="10 of 9 symbols in their order, for 40 to 270 steps",
        success="All ten commands are carried out.",
        figures=Figures(random=0.023, memoryless=0.03, best=1.0, source="measured; memoryless: a bound"),
        memoryless=f"{PLAYERS}.walkers:AnyTile",
        oracle=f"{PLAYERS}.walkers:MortarOracle",
        source=_ENDLESS,
    )


def _mystery_path() -> BaseTask:
    return BaseTask(
        name="MysteryPath-v0",
        family="MysteryPath",
        entry_point="vla_eval.base_tasks.mystery_path:MysteryPathEnv",
        horizon_steps=512,
        memory=("capacity", "spatial"),
        tier="complex image",
        extra="base",
        description="Find an invisible path by trial, and follow it.",
        remember="the path and the tiles that failed, for up to 512 steps",
        success="The end of the path is reached.",
        figures=Figures(random=0.22, memoryless=None, best=1.82, source="measured; best: the path is known"),
        memoryless=None,
        oracle=f"{PLAYERS}.walkers:PathOracle",
        source=_ENDLESS,
    )


def _two_colors() -> Iterator[BaseTask]:
    colour = "Take vests of the pillar's colour, on a floor that hurts."
    bit = "1 bit for up to 500 steps; taking one vest shows it again"
    alive = "The player is alive at the end."
    measured = (
        "measured, 60, 60 and 24 episodes; memoryless: red ones by their pixels; best: places are known"
    )
    quoted = "; a walker that knows places but not the colour: 17.1 (quoted)"
    rows = (
        ("Base", 525, colour, bit, alive, (4.4, 11.1, 53.7), measured),
        ("Hard", 525, colour, bit, alive, (4.5, 11.5, 53.6), measured + quoted),
        (
            "Delay1000",
            575,
            "See a pillar, stay alive for 2000 tics, then choose the vest of its colour.",
            "1 bit for 500 steps; the return does not ask for it, success does",
            "The vest has the pillar's colour.",
            (1.2, 26.9, 40.8),
            f"{measured}. Success: 0.00, 0.47, 1.00",
        ),
    )
    for name, horizon_steps, description, remember, success, known, source in rows:
        random, memoryless, best = known
        yield BaseTask(
            name=f"ViZDoomTwoColors{name}-v0",
            family="ViZDoomTwoColors",
            entry_point="vla_eval.base_tasks.doom.two_colors:TwoColorsEnv",
            kwargs={"level": name.lower()},
            horizon_steps=horizon_steps,
            memory=("object",),
            tier="complex image",
            extra="base-3d",
            description=description,
            remember=remember,
            success=success,
            figures=Figures(random=random, memoryless=memoryless, best=best, source=source),
            memoryless=f"{PLAYERS}.two_colors:RedInView",
            oracle=f"{PLAYERS}.two_colors:Oracle",
            source="griver/memup at d276571 (no licence: rules only, own map), Freedoom by vizdoom (MIT)",
        )


def _memory_maze() -> Iterator[BaseTask]:
    small = {"max_rooms": 6, "room_min_size": 3, "room_max_size": 5}
    large = {"max_rooms": 9, "room_min_size": 3, "room_max_size": 3}
    rows = (
        (9, 3, small, 1000, 0.25, 31.5, 26.4),
        (11, 4, small, 2000, 0.3, 52.4, 44.3),
        (13, 5, small, 3000, 0.15, 67.2, 55.5),
        (15, 6, large, 4000, 0.3, 75.2, 67.7),
    )
    for side, n_targets, rooms, horizon_steps, random, best, people in rows:
        yield BaseTask(
            name=f"MemoryMaze-{side}x{side}-v0",
            family="MemoryMaze",
            entry_point="vla_eval.base_tasks.memory_maze:MemoryMazeEnv",
            kwargs={"side": side, "n_targets": n_targets, "rooms": rooms},
            horizon_steps=horizon_steps,
            memory=("spatial",),
            tier="complex image",
            extra="base-3d",
            description="Walk through a maze to the target of the colour that is asked for, again and again.",
            remember=f"the maze and the places of {n_targets} targets, for {horizon_steps} steps",
            success=None,
            figures=Figures(
                random=random,
                memoryless=None,
                best=best,
                source=f"measured in 20 episodes; best: the map is known; people: {people}, as published",
            ),
            memoryless=None,
            oracle=f"{PLAYERS}.memory_maze:Oracle",
            source="jurgisp/memory-maze at 4030901 (MIT), after Pasukonis et al. 2022",
            is_slow=True,
        )
