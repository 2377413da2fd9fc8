"""The delays of another run, which `chunking.delay.trace` names: the one place that reads them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from vla_eval.chunking import ChunkingSettings
from vla_eval.config.files import digest_of
from vla_eval.errors import RecipeError
from vla_eval.latency import DelayTrace, EpisodeName, VaryingDelay
from vla_eval.storage.run_folder import read_run


@dataclass(frozen=True, slots=True, kw_only=True)
class RunDelays:
    """How long each inference of a run took, in control steps."""

    path: Path
    episodes: Mapping[EpisodeName, tuple[int, ...]]

    @classmethod
    def of(cls, chunking: ChunkingSettings) -> Self | None:
        """Read the run that a configuration names; None if it names none.

        Raises:
            RecipeError: the run has no delays.
            RunFolderError: it is no run folder.
        """
        delay = chunking.delay
        if not isinstance(delay, VaryingDelay) or delay.trace is None:
            return None
        run = read_run(Path(delay.trace))
        found: dict[EpisodeName, tuple[int, ...]] = {
            one.key: one.delay_steps for one in run.records if one.delay_steps is not None
        }
        if not found:
            raise RecipeError(
                f"chunking.delay.trace: {delay.trace}: expected a run whose delays were measured, drawn or "
                f"replayed, found {len(run.records)} episodes without delays of their own. Run it with --set "
                "chunking.delay=measured; a delay that is one number is given as a number."
            )
        return cls(path=Path(delay.trace), episodes=found)

    @property
    def sha256(self) -> str:
        """The digest of what results depend on."""
        return digest_of({"delays": [[*name, list(own)] for name, own in sorted(self.episodes.items())]})

    def narrowed(self, *, task: str, policy: str, n_action_steps: int) -> DelayTrace:
        """Return what concerns one row of a table."""
        return DelayTrace.narrowed(self.episodes, task=task, policy=policy, n_action_steps=n_action_steps)

    def note(self, planned: Sequence[EpisodeName]) -> str:
        """Say how many of the planned episodes are in the trace."""
        n_found = len(self.episodes.keys() & set(planned))
        return (
            f"delays: {self.path} has {n_found} of these {len(planned)} episodes. The others, and inferences "
            "beyond an episode's last, draw from its delays of the same policy."
        )
