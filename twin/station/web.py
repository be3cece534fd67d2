"""Rerun's web viewer from the installed package, served to this machine's browser and to nothing else.

Rerun can serve it too, but then to every interface, and its page fetches fonts and a telemetry script from
elsewhere. Here a content security policy leaves the page nothing but this server and the run's own stream, and a
token as that of the operator's page is asked for.
"""

import base64
import contextlib
import hashlib
import logging
import re
import secrets
import socket
import subprocess
import tempfile
import threading
import time
import urllib.error
import urllib.request
import zipfile
from pathlib import Path
from urllib.parse import quote, urlsplit

import rerun as rr
import uvicorn
from fastapi import FastAPI, Response
from fastapi.responses import FileResponse, RedirectResponse

from twin.plant.errors import InputError, RunError
from twin.rig.rerun_tool import rerun_environment, rerun_program
from twin.station.guard import Guard
from twin.station.native import MEMORY_LIMIT, Broadcast, free_port

MEDIA_TYPES = {
    "index.html": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "favicon.ico": "image/x-icon",
}
_HOST = "127.0.0.1"
_START_TIMEOUT_S = 20.0


class WebViewer:
    """Serves one stream to browsers on this machine.

    Parameters
    ----------
    stream
        Its sinks are replaced by a server for viewers; feed it through a `LiveView`.
    memory_limit
        How much of the run is kept for browsers that come late, such as ``100MB``.

    Attributes
    ----------
    source
        URL of the stream once it is served; ``rerun URL`` shows it in a window.
    """

    def __init__(self, stream: rr.RecordingStream, *, memory_limit: str = MEMORY_LIMIT) -> None:
        self._stream = stream
        self._memory_limit = memory_limit
        self._files = tempfile.TemporaryDirectory(prefix="atmd-web-")
        self.source = ""
        self._server: uvicorn.Server | None = None
        self._thread: threading.Thread | None = None

    def start(self, port: int = 0) -> str:
        """Start serving and return the URL to open, its token with it.

        Parameters
        ----------
        port
            TCP port for the page; 0 takes a free one.

        Raises
        ------
        InputError
            If the installed Rerun has no web viewer, or the port is taken.
        RunError
            If the server does not come up.
        """
        fetch_viewer(Path(self._files.name))
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((_HOST, port))
        except OSError as error:
            listener.close()
            raise InputError(f"port {port} cannot be used ({error.strerror}); give another one") from error
        port = int(listener.getsockname()[1])
        hosts = [f"{name}:{port}" for name in (_HOST, "localhost")]
        page, token = f"http://{hosts[0]}", secrets.token_urlsafe(24)
        self.source = Broadcast(self._stream, self._memory_limit, [f"http://{host}" for host in hosts]).url
        files = Path(self._files.name)
        app = Guard(
            viewer_app(files, self.source),
            token,
            hosts,
            security_policy(
                (files / "index.html").read_text(encoding="utf-8"), urlsplit(self.source).port or 0
            ),
            logging.getLogger(__name__).info,
            f"atmdview{port}",
            framed=True,
        )
        self._server = uvicorn.Server(
            uvicorn.Config(app, log_level="warning", lifespan="off", access_log=False)
        )
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [listener]}, name="web viewer", daemon=True
        )
        self._thread.start()
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > deadline:
                raise RunError(f"the web viewer's server at {page} did not start; try another port")
            time.sleep(0.02)
        return f"{page}/?token={token}"

    def stop(self) -> None:
        """Stop serving; browsers keep what they have."""
        self._stream.disconnect()
        if self._server is not None and self._thread is not None:
            self._server.should_exit = True
            self._thread.join(5.0)
            self._server = self._thread = None
        self._files.cleanup()


def viewer_app(files: Path, source: str) -> FastAPI:
    """Application that serves the viewer's files; ``/`` opens it on the stream at that URL."""
    app = FastAPI(title="atmd", docs_url=None, redoc_url=None, openapi_url=None)
    stream_url = quote(source, safe="")

    @app.get("/")
    def home() -> RedirectResponse:
        return RedirectResponse(f"/index.html?url={stream_url}&persist=0&hide_welcome_screen&theme=dark")

    @app.get("/{name}")
    def file(name: str) -> Response:
        # Only names from the table ever reach the file system.
        if name not in MEDIA_TYPES or not (files / name).is_file():
            return Response(status_code=404)
        # To be asked for again each time, but not sent again: it is 40 MB.
        return FileResponse(
            files / name, media_type=MEDIA_TYPES[name], headers={"Cache-Control": "private, no-cache"}
        )

    return app


def security_policy(page: str, data_port: int) -> str:
    """Content security policy: this server, the stream at that port, and the page's own inline scripts."""
    scripts = re.findall(r"<script(?![^>]*\bsrc=)[^>]*>(.*?)</script>", page, flags=re.DOTALL)
    hashes = [
        f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"
        for script in scripts
    ]
    rules = {
        "default-src": "'none'",
        "script-src": " ".join(["'self'", "'wasm-unsafe-eval'", *hashes]),
        "style-src": "'self' 'unsafe-inline'",
        "img-src": "'self' data: blob:",
        "font-src": "'self' data:",
        "worker-src": "'self' blob:",
        "connect-src": f"'self' http://{_HOST}:{data_port}",
        "frame-ancestors": f"'self' http://{_HOST}:* http://localhost:*",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def fetch_viewer(folder: Path) -> None:
    """Put the installed Rerun's web viewer into a folder.

    Some of its packages carry the files in an archive, the others inside the program, which hands them out
    only by serving them.

    Raises
    ------
    InputError
        If there are none.
    """
    archive = Path(rr.__file__).parent / "web_viewer.zip"
    if archive.is_file():
        with zipfile.ZipFile(archive) as packed:
            for entry in packed.namelist():
                if Path(entry).name in MEDIA_TYPES:
                    (folder / Path(entry).name).write_bytes(packed.read(entry))
    else:
        _fetch_from_program(folder)
    missing = [name for name in MEDIA_TYPES if name != "favicon.ico" and not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"the installed Rerun has no web viewer ({', '.join(missing)} missing); "
            "reinstall rerun-sdk from a wheel, or use the native viewer"
        )


def _fetch_from_program(folder: Path) -> None:
    page_port, data_port = free_port(), free_port()
    command = [rerun_program(), "--serve-web", "--bind", _HOST, "--web-viewer-port", str(page_port)]
    command += ["--port", str(data_port), "--server-memory-limit", "1MB"]
    with tempfile.TemporaryDirectory() as home:
        # It would open a browser if it found one.
        quiet = rerun_environment() | {"BROWSER": "true", "HOME": home}
        program = subprocess.Popen(command, env=quiet, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            deadline = time.monotonic() + _START_TIMEOUT_S
            for name in MEDIA_TYPES:
                while program.poll() is None and time.monotonic() < deadline:
                    with contextlib.suppress(urllib.error.URLError, ConnectionError):
                        _download(f"http://{_HOST}:{page_port}/{name}", folder / name)
                        break
                    time.sleep(0.05)
        finally:
            program.terminate()
            program.wait()


def _download(url: str, path: Path) -> None:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(url, timeout=10.0) as answer:
            path.write_bytes(answer.read())
    except urllib.error.HTTPError:
        return  # a viewer without this file; what is needed is checked afterwards
