"""Fields of LeRobot's configurations that say how chunks are executed, and how each is answered here."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any  # JSON of another program

from vla_eval.checkpoints.files import CONFIG_FILE, read_json
from vla_eval.checkpoints.notes import COMPILE, checkpoint_folder
from vla_eval.chunking import ChunkingSpec

RTC = (
    "whether chunks join is what the evaluation says. Guided as LeRobot does it: --set chunking.mode=rtc, "
    "with the fields of chunking.rtc"
)
DRAWS = "an inference's draws depend on task, seed, run and control step"


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """How a field is answered."""

    translated: str | None = None  # into what of ours; None: the field is ignored
    instead: str = ""  # of an ignored one: what holds, and how to get what it asks for
    off: bool | None = None  # its value that asks for nothing, which the policy is built with


EXECUTION_FIELDS: Mapping[str, Answer] = {
    "n_action_steps": Answer(translated="the default of --n-action-steps"),
    "n_obs_steps": Answer(translated="the frames that an inference gets"),
    "temporal_ensemble_coeff": Answer(
        instead="chunks are executed as the evaluation says. The same is --n-action-steps 1 --set "
        "chunking.mode=temporal_ensemble --set chunking.ensemble_decay={value}"
    ),
    "rtc_config": Answer(instead=RTC),
    "rtc_ramp_rate": Answer(instead="real-time chunking of this type is of its own kind, and not done here"),
    "per_episode_seed": Answer(instead=DRAWS, off=False),
    "eval_seed": Answer(instead=DRAWS),
    "compile_model": Answer(
        instead="the network is computed as it is. Compiled: --set compile=true", off=False
    ),
}
"""Field -> how it is answered."""


def without_execution(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration in which the ignored fields ask for nothing: some policies act on them."""
    off = {name: answer.off for name, answer in EXECUTION_FIELDS.items() if answer.translated is None}
    return {name: off.get(name, value) for name, value in data.items()}


def ignored_fields(
    adapter: str, args: Mapping[str, Any], *, chunking: ChunkingSpec | None = None
) -> tuple[str, ...]:
    """Return a sentence for each field of a policy's checkpoint that asks for what is not done here."""
    folder = checkpoint_folder(adapter, args)
    if folder is None:
        return ()
    file = folder / CONFIG_FILE
    data = read_json(file)
    return tuple(
        f"{file}: {name} = {value!r:.200} is ignored: {answer.instead.format(value=value)}."
        for name, answer in EXECUTION_FIELDS.items()
        if answer.translated is None
        and (value := data.get(name)) not in (None, False)
        and not (isinstance(value, dict) and value.get("enabled") is False)
        and not (name == "temporal_ensemble_coeff" and _ensembles(chunking, value))
        and not (name == "compile_model" and args.get(COMPILE))
    )


def _ensembles(chunking: ChunkingSpec | None, decay: object) -> bool:
    return (
        chunking is not None
        and chunking.mode == "temporal_ensemble"
        and (chunking.n_action_steps, chunking.ensemble_decay) == (1, decay)
    )
