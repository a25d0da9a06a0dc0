"""A model hub on the loopback: the requests that huggingface_hub's client makes, from a folder."""

import hashlib
import json
import re
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from huggingface_hub import constants

COMMIT = "0123456789abcdef0123456789abcdef01234567"
LARGE = 1000
"""Files above this size in bytes are published with their SHA-256, as in Git LFS."""


class Hub:
    """Repository that is served, and the requests that came."""

    def __init__(self, folder, repository):
        self.folder, self.repository = folder, repository
        self.commit = COMMIT
        self.cut = set()
        """Files whose next download ends after half of the bytes."""
        self.requests = []
        """Method, path and Range header of each request."""

    def files(self):
        return {
            p.relative_to(self.folder).as_posix(): p.read_bytes()
            for p in sorted(self.folder.rglob("*"))
            if p.is_file()
        }

    def info(self):
        siblings = []
        for name, data in self.files().items():
            sha = hashlib.sha256(data).hexdigest()
            lfs = {"sha256": sha, "size": len(data), "pointerSize": 130}
            about = {"rfilename": name, "size": len(data), "blobId": sha[:40]}
            siblings.append(about | ({"lfs": lfs} if len(data) > LARGE else {}))
        return {"id": self.repository, "sha": self.commit, "siblings": siblings}

    def tree(self):
        return [
            {"type": "file", "path": file["rfilename"], "size": file["size"], "oid": file["blobId"]}
            for file in self.info()["siblings"]
        ]


def _handler(hub):
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *args):
            pass

        def _send(self, code, body=b"", head=(), end=None):
            self.send_response(code)
            for name, value in {"Content-Length": str(len(body)), **dict(head)}.items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body[:end])
            if end is not None:
                self.close_connection = True

        def do_GET(self):
            hub.requests.append((self.command, self.path, self.headers.get("Range")))
            api = re.match(
                rf"/api/models/{hub.repository}(?:/(?:revision|tree)/([^?]+))?(?:\?|$)", self.path
            )
            file = re.match(rf"/{hub.repository}/resolve/([^/]+)/(.+)$", self.path)
            wanted = (api or file) and (api or file)[1]
            if wanted not in (None, "main", hub.commit) or not (api or file):
                error = "RevisionNotFound" if api or file else "RepoNotFound"
                self._send(404, head=[("X-Error-Code", error)])
            elif api:
                body = json.dumps(hub.tree() if "/tree/" in self.path else hub.info()).encode()
                self._send(200, body, [("Content-Type", "application/json")])
            else:
                self._file(file[2])

        do_HEAD = do_GET  # noqa: N815 - the name that http.server calls

        def _file(self, name):
            data = hub.files()[name]
            sha = hashlib.sha256(data).hexdigest()
            head = {"ETag": f'"{sha}"', "X-Repo-Commit": hub.commit, "Accept-Ranges": "bytes"}
            span = re.match(r"bytes=(\d+)-(\d*)", self.headers.get("Range") or "")
            if span:
                start, stop = int(span[1]), int(span[2] or len(data) - 1) + 1
                head["Content-Range"] = f"bytes {start}-{stop - 1}/{len(data)}"
                self._send(206, data[start:stop], head.items())
            elif self.command == "GET" and name in hub.cut:
                hub.cut.discard(name)
                self._send(200, data, head.items(), end=len(data) // 2)
            else:
                self._send(200, data, head.items())

    return Handler


@contextmanager
def serve(hub, monkeypatch):
    """Serve a hub, and point huggingface_hub's client to it."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(hub))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    monkeypatch.setattr(constants, "ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    template = constants.ENDPOINT + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(constants, "DOWNLOAD_CHUNK_SIZE", 100_000)  # kept when a download is cut
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
