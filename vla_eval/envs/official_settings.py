"""What can be asked of the official package's environments; known without the package and a simulator."""

from typing import Literal

from vla_eval.config.environment import AS_DESIGNED, EnvSettings
from vla_eval.errors import TaskArgumentError, check_names
from vla_eval.tasks.arguments import HORIZON, check_argument
from vla_eval.tasks.objects.limits import SomeSteps
from vla_eval.tasks.spec import TaskSpec

MUG = "mug"
"""Name of the argument of the shell games: whose mug. Other tasks take it, too, for one run of all."""
Mug = Literal["ycb", "stand_in"]
BULB = "bulb"
"""Name of the argument of tasks with a lamp: whose light bulb. Other tasks take it, too."""
Bulb = Literal["package", "stand_in"]
WITH_LAMPS = (
    *("ShellGameColorLamp", "ShellGameShuffleColorLamp", "BatteriesChecker", "BlinkCount", "TraceShape"),
    *("TimedTransfer", "GatherAndRecall"),
)
"""How the names of the tasks with a lamp begin."""


def check_official(settings: EnvSettings, row: TaskSpec) -> None:
    """Refuse settings that the official environments do not have."""
    check_names("argument", settings.kwargs, (HORIZON, MUG, BULB), where=row.id)
    asked = {
        "sim_backend=gpu": settings.sim_backend == "gpu",
        "appearance": settings.appearance != AS_DESIGNED,
        f"render.wrist_mesh={settings.render.wrist_mesh}": settings.render.wrist_mesh == "simplified",
    }
    for what, is_asked in asked.items():
        if is_asked:
            raise TaskArgumentError(
                f"{row.id}: {what}: the official environments run on the CPU simulator and look as they are. "
                "Leave this setting out for them."
            )
    if HORIZON in settings.kwargs:
        check_argument(SomeSteps, settings.kwargs[HORIZON], name=HORIZON, task=row.id)
    for name, kind in ((MUG, Mug), (BULB, Bulb)):
        if name in settings.kwargs:
            check_argument(kind, settings.kwargs[name], name=name, task=row.id)
