"""The watchdog of a robot arm: frozen cameras, late commands, and the time between control steps.

Time comes from a `Clock`, so that a simulated arm needs no waiting and a test no seconds.
"""

import time
from collections.abc import Mapping
from typing import Protocol

from vla_eval.core import ImageArray
from vla_eval.errors import RobotCameraError, RobotTimingError


class Clock(Protocol):
    """Seconds, and waiting for them."""

    def now(self) -> float:
        """Return the time, s, from any start."""

    def sleep(self, seconds: float) -> None:
        """Wait; not at all for a time that is over."""


class WallClock:
    """Time as it passes."""

    def now(self) -> float:
        """Return seconds since some start."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(max(seconds, 0.0))


class StepClock:
    """Time that passes by waiting alone: a simulated arm does not depend on the machine."""

    def __init__(self) -> None:
        """Begin at 0."""
        self._now = 0.0

    def now(self) -> float:
        """Return the seconds that were waited for."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """Let them pass."""
        self._now += max(seconds, 0.0)


class CameraWatch:
    """Counts identical images in a row: by its noise, a camera that works never gives the same one twice."""

    def __init__(self, *, stale_frames: int) -> None:
        """Begin without an image."""
        self._stale_frames = stale_frames
        self._last: dict[str, bytes] = {}
        self._n_same: dict[str, int] = {}

    def check(self, images: Mapping[str, ImageArray]) -> None:
        """Raise `RobotCameraError` if a camera has given the same bytes `stale_frames` times in a row."""
        for name, image in images.items():
            content = image.tobytes()
            is_same = content == self._last.get(name)
            self._last[name] = content
            self._n_same[name] = self._n_same[name] + 1 if is_same else 1
            if self._n_same[name] >= self._stale_frames:
                raise RobotCameraError(
                    f"camera '{name}': expected new images, found the same one {self._n_same[name]} times "
                    "in a row (stale_frames). It is frozen: check it, then run the command again."
                )


class Pace:
    """Keeps the time between commands at a control step, and notices when it was too long."""

    def __init__(self, clock: Clock, *, control_hz: float, max_gap_seconds: float) -> None:
        """Begin without a command."""
        self._clock = clock
        self._period = 1 / control_hz
        self._max_gap_seconds = max_gap_seconds
        self._last: float | None = None  # time of the last command

    def begin(self) -> None:
        """Forget the last command: what follows is no gap."""
        self._last = None

    def check(self) -> None:
        """Raise `RobotTimingError` if the last command is too long ago; call it before the next one."""
        now = self._clock.now()
        if self._last is not None and now - self._last > self._max_gap_seconds:
            raise RobotTimingError(
                f"expected a command at least every {self._max_gap_seconds:g} s (max_gap_seconds), found "
                f"none for {now - self._last:.2f} s. The policy or the machine was too slow: use a faster "
                "one, or a larger max_gap_seconds if the arm may wait."
            )
        self._last = now

    def wait(self) -> None:
        """Wait until a control step after the last command."""
        if self._last is not None:
            self._clock.sleep(self._last + self._period - self._clock.now())
