"""Does a policy server keep the protocol? Its errors are those of this package."""

from collections.abc import Callable

from vla_eval.errors import ConformanceError
from vla_eval.lock.switch import let_connect
from vla_eval.wire import check


def check_remote(
    url: str,
    *,
    api_key: str | None = None,
    timeout_seconds: float = 60.0,
    report: Callable[[str], None] = lambda requirement: None,
) -> list[str]:
    """Check a server as `vla_eval.wire.check.check_remote` does.

    Args:
        url: `ws://HOST:PORT`.
        api_key: the server's key, if it wants one.
        timeout_seconds: how long a reply may take.
        report: called with each requirement that is met, as soon as that is known.

    Returns:
        The requirements that are met.

    Raises:
        ConformanceError: one is not, or the server cannot be reached.
    """
    let_connect(f"the server that is checked, {url}")
    try:
        return check.check_remote(url, api_key=api_key, timeout_seconds=timeout_seconds, report=report)
    except check.CheckFailedError as exc:
        raise ConformanceError(str(exc)) from exc
