"""A family as a contributor adds it: this folder, the row below, and a recipe (in the test)."""

from collections.abc import Callable
from typing import Any

from vla_eval.evaluation.worker import EpisodeRunner
from vla_eval.models.families import FAMILIES
from vla_eval.models.family import Base, Family, Source, Tiny
from vla_eval.workers.inside import Heartbeat
from vla_eval.workers.messages import Notice

ROW = Family(
    type="mikasa_toy",
    configuration="toy_family.configuration_toy",
    docs="docs/toy.md",
    is_built_empty=True,
    draws_nothing=True,
    stages="toy_family.configuration_toy:network_stages",
    saved_per_linear=2.0,
    tiny=Tiny(),
    converter="toy_family.conversion:read_original",
    convert_options="toy_family.conversion:ToyOptions",
    bases=(
        Base(
            name="toy_base",
            title="Toy",
            terms="none",
            parts=(Source(repo_id="somebody/toy", revision=None, patterns=("*.safetensors",)),),
            options={"scale": 2.0},
        ),
    ),
)


def toy_runner(heartbeat: Heartbeat, tell: Callable[[Notice], None], **options: Any) -> EpisodeRunner:
    """Make the runner of a worker that knows the row; see `RunnerClass`."""
    FAMILIES[ROW.type] = ROW
    return EpisodeRunner(heartbeat, tell, **options)
