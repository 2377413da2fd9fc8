"""The inside of a worker with a simulator: keeps the environment between jobs that need the same one."""

import logging
from collections.abc import Callable

from vla_eval.config.environment import EnvSettings
from vla_eval.core import SimEnv
from vla_eval.envs.factory import describe_device, make_env
from vla_eval.errors import VlaEvalError
from vla_eval.workers.inside import Heartbeat
from vla_eval.workers.jobs import Job
from vla_eval.workers.messages import DeviceFound, Failed, describe_error

logger = logging.getLogger(__name__)


class SimulatorRunner[J: Job, A]:
    """Answers jobs of one kind; a `workers.inside.Runner`."""

    def __init__(self, heartbeat: Heartbeat, tell: Callable[[DeviceFound], None]) -> None:
        self._heartbeat, self._tell = heartbeat, tell
        self._env: SimEnv | None = None
        self._env_settings: EnvSettings | None = None
        self._device: dict[str, str] = {}

    def answer(self, job: J) -> A | Failed:
        """Do the job; whatever goes wrong becomes a `Failed`."""
        self._heartbeat.begin_batch()
        self._heartbeat("setup")
        try:
            return self._do(job)
        except BaseException as exc:  # also SystemExit: a policy must not end the worker unseen
            logger.exception("%s, stage %s", job.setup_key, self._heartbeat.stage)
            known = self._explained(exc, job)
            return Failed(
                error=describe_error(known, self._heartbeat.stage), refused=isinstance(known, VlaEvalError)
            )

    def close(self) -> None:
        """Release the simulator."""
        if self._env is not None:
            self._env.close()
        self._env = self._env_settings = None

    def _do(self, job: J) -> A:
        raise NotImplementedError

    def _explained(self, exc: BaseException, _job: J) -> BaseException:
        """Return the error to report in place of what was raised."""
        return exc

    def _make_env(self, settings: EnvSettings) -> SimEnv:
        if self._env is None or self._env_settings != settings:
            self.close()
            self._env, self._env_settings = make_env(settings), settings
            self._device = describe_device(self._env)
            if self._device and settings.cameras:
                self._tell(DeviceFound(device=self._device))
        return self._env
