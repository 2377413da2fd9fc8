"""What can be asked of the official package's environments; known without the package and a simulator."""

from vla_eval.config.appearance import AS_DESIGNED
from vla_eval.config.environment import EnvSettings
from vla_eval.errors import TaskArgumentError, check_names
from vla_eval.tasks.spec import TaskSpec

ARGUMENTS = ("horizon_steps", "mug")


def check_official(settings: EnvSettings, row: TaskSpec) -> None:
    """Refuse settings that the official environments do not have."""
    check_names("argument", settings.kwargs, ARGUMENTS, where=row.id)
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
    horizon_steps = settings.kwargs.get("horizon_steps", row.horizon_steps)
    if not isinstance(horizon_steps, int) or isinstance(horizon_steps, bool) or horizon_steps < 1:
        raise TaskArgumentError(f"{row.id}: horizon_steps={horizon_steps!r}: expected a number ≥ 1.")
