"""Serve a policy to mikasa-vla-eval from another Python environment; check any such server.

`serve(policy, spec)` serves until Ctrl-C; `check_remote(url)` raises `CheckFailedError` for the first
requirement that is not met.
"""

from mikasa_vla_client.check import CheckFailedError, check_remote
from mikasa_vla_client.server import Episode, PolicyServer, Session, serve
from mikasa_vla_client.spec import PolicySpec, SpecError, __version__

__all__ = [
    "CheckFailedError",
    "Episode",
    "PolicyServer",
    "PolicySpec",
    "Session",
    "SpecError",
    "__version__",
    "check_remote",
    "serve",
]
