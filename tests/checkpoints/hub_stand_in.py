"""A stand-in for the Hub's HTTP interface on 127.0.0.1: repositories are folders; connections can be cut."""

import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

COMMIT = "0123456789abcdef0123456789abcdef01234567"
INFO = re.compile(r"/api/models/([^/]+/[^/?]+)(/revision/([^?]+))?(\?.*)?$")
FILE = re.compile(r"/([^/]+/[^/]+)/resolve/([^/]+)/([^?]+)")


@dataclass
class Hub:
    """What is served, what was asked for, and where connections end.

    Attributes:
        repositories: `OWNER/NAME` -> folder.
        gated: repositories whose files are refused with 403.
        cut_after_bytes: name of a file -> after how many bytes of a response its connection is cut.
        n_cuts: how many connections are still to be cut; the first ones.
        refuses: whether every request for a file's content fails.
        requests: (method, name of the file, Range header) of each request for a file.
    """

    repositories: dict[str, Path]
    gated: set[str] = field(default_factory=set)
    cut_after_bytes: dict[str, int] = field(default_factory=dict)
    n_cuts: int = 0
    refuses: bool = False
    requests: list[tuple[str, str, str | None]] = field(default_factory=list)
    endpoint: str = ""

    def content_of(self, name: str) -> list[str | None]:
        """Return the Range headers of the requests for a file's content."""
        return [asked for method, file, asked in self.requests if method == "GET" and file == name]


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


class _Handler(BaseHTTPRequestHandler):
    hub: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: Any) -> None:
        """Stay silent."""

    def do_HEAD(self) -> None:
        self._file(with_content=False)

    def do_GET(self) -> None:
        info = INFO.fullmatch(self.path)
        if info is None:
            self._file(with_content=True)
        elif info[1] not in self.hub.repositories:
            self._refuse(404, "RepoNotFound")
        else:
            self._describe(info[1])

    def _describe(self, repo: str) -> None:
        siblings = []
        for name, content in self._files(repo):
            lfs = {"lfs": {"sha256": sha256(content), "size": len(content), "pointerSize": 1}}
            large = name.endswith(".safetensors")
            siblings.append({"rfilename": name, "size": len(content), **(lfs if large else {})})
        self._json({"id": repo, "sha": COMMIT, "siblings": siblings, "cardData": {"license": "apache-2.0"}})

    def _files(self, repo: str) -> Iterator[tuple[str, bytes]]:
        root = self.hub.repositories[repo]
        for path in sorted(root.rglob("*")):
            if path.is_file():
                yield path.relative_to(root).as_posix(), path.read_bytes()

    def _json(self, data: object) -> None:
        self._send(200, json.dumps(data).encode(), {"Content-Type": "application/json"})

    def _file(self, *, with_content: bool) -> None:
        found = FILE.match(self.path)
        assert found is not None, self.path
        repo, commit, name = found.groups()
        asked = self.headers.get("Range")
        self.hub.requests.append((self.command, name, asked))
        if repo in self.hub.gated:
            self._refuse(403, "GatedRepo")
            return
        if with_content and self.hub.refuses:
            self._refuse(503, None)
            return
        content = (self.hub.repositories[repo] / name).read_bytes()
        headers = {"ETag": f'"{sha256(content)}"', "X-Repo-Commit": commit, "Accept-Ranges": "bytes"}
        status = 200
        if asked is not None:
            first = int(asked.removeprefix("bytes=").partition("-")[0])
            headers["Content-Range"] = f"bytes {first}-{len(content) - 1}/{len(content)}"
            content, status = content[first:], 206
        self._send(status, content, headers, name=name if with_content else None, body=with_content)

    def _send(
        self, status: int, content: bytes, headers: dict[str, str], name: str | None = None, body: bool = True
    ) -> None:
        self.send_response(status)
        for key, value in {**headers, "Content-Length": str(len(content))}.items():
            self.send_header(key, value)
        self.end_headers()
        if not body:
            return
        limit = self.hub.cut_after_bytes.get(name or "")
        if limit is not None and self.hub.n_cuts > 0 and limit < len(content):
            self.hub.n_cuts -= 1
            self.wfile.write(content[:limit])
            self.wfile.flush()
            self.close_connection = True
            return
        self.wfile.write(content)

    def _refuse(self, status: int, code: str | None) -> None:
        headers = {"X-Error-Code": code, "X-Error-Message": "refused"} if code is not None else {}
        self._send(status, b"{}", headers, body=self.command == "GET")


@contextmanager
def serving(hub: Hub) -> Iterator[Hub]:
    """Serve it; `hub.endpoint` is then its address."""
    handler = type("Handler", (_Handler,), {"hub": hub})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    hub.endpoint = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
