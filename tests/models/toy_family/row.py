"""A family as a contributor adds it: this folder, the row below, and a recipe (in the test)."""

from multiprocessing.connection import Connection
from pathlib import Path

from vla_eval.evaluation.worker import worker_main
from vla_eval.models.families import FAMILIES
from vla_eval.models.family import Base, Family, Source, Tiny
from vla_eval.workers.inside import SharedStage

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


def toy_worker_main(connection: Connection, shared: SharedStage, log: Path) -> None:
    """Run a worker that knows the row; see `worker_main`."""
    FAMILIES[ROW.type] = ROW
    worker_main(connection, shared, log)
