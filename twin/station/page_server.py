"""The operator page, served from a thread of the station: status, what-if, proposals, orders. The loop never waits."""

import asyncio
import contextlib
import ipaddress
import json
import logging
import math
import re
import secrets
import socket
import threading
import time
from collections.abc import AsyncIterator, Iterator
from importlib.resources import files
from types import TracebackType
from typing import Annotated, Any, Self
from urllib.parse import urlsplit

import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field

from tuning.branch import BranchTrace
from tuning.whatif import CurvePoint, Curves, Design
from twin.plant.errors import InputError, RunError
from twin.station.desk import ARMED_S, Desk, RefusedError, parse_changes
from twin.station.guard import Guard
from twin.station.panel import finite
from twin.station.playback import Action, Wish
from twin.station.whatif_process import BRANCH_STEP

START_TIMEOUT_S = 20.0
STATE_EVERY_S = 0.2
FILES = {
    "page.css": "text/css; charset=utf-8",
    "page.js": "text/javascript; charset=utf-8",
    "status.js": "text/javascript; charset=utf-8",
    "charts.js": "text/javascript; charset=utf-8",
    "curves.js": "text/javascript; charset=utf-8",
    "orders.js": "text/javascript; charset=utf-8",
    "player.js": "text/javascript; charset=utf-8",
    "icon.svg": "image/svg+xml",
}
Value = float | str | None

EMPTY_STYLE = "'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='"
"""A style sheet without a letter, which the charts begin with and fill through the document's own interface."""


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class WhatIfBody(_Body):
    """Settings that are different."""

    changes: Annotated[dict[str, Value], Field(max_length=20)] = Field(default_factory=dict)
    seconds: Annotated[float, Field(ge=0.1, le=5.0)] = 1.0


class SeenBody(_Body):
    """An order, and the data its giver was looking at."""

    seen_sample: Annotated[int, Field(ge=0, le=2**53)]


class ReviewBody(_Body):
    """A standing proposal to look at."""

    standing: Annotated[int, Field(ge=1)]


class ArmBody(SeenBody):
    """A reviewed proposal."""

    proposal: Annotated[int, Field(ge=1)]


class SendBody(ArmBody):
    """An armed proposal."""

    code: Annotated[str, Field(max_length=64)]


class PlayerBody(_Body):
    """What a recording is to do; the value is the instant [s] of a seek, or a speed."""

    action: Action
    value: float = 0.0


def page_app(desk: Desk, over: threading.Event) -> FastAPI:
    """Everything behind the guard; streams end when it is over."""
    app = FastAPI(title="atmd", docs_url=None, redoc_url=None, openapi_url=None)
    folder = files("twin.station") / "page"
    charts = (files("plotly") / "package_data" / "plotly.min.js").read_bytes()
    index = (folder / "index.html").read_bytes().replace(b"<!-- charts -->", _stand_ins(charts))

    @app.exception_handler(RefusedError)
    def refused(request: Request, error: RefusedError) -> Response:
        desk.refuse(f"{request.url.path} refused: {error}")
        return JSONResponse({"reason": str(error)}, status_code=error.status)

    @app.exception_handler(InputError)
    def unusable(request: Request, error: InputError) -> Response:
        desk.refuse(f"{request.url.path} refused: {error}")
        return JSONResponse({"reason": str(error)}, status_code=422)

    @app.exception_handler(RunError)
    def failed(request: Request, error: RunError) -> Response:
        return JSONResponse({"reason": str(error)}, status_code=503)

    @app.exception_handler(RequestValidationError)
    def malformed(request: Request, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        place = ".".join(str(p) for p in first["loc"][1:])[:60]
        reason = f"malformed: {place + ': ' if place else ''}{first['msg']}"
        desk.refuse(f"{request.url.path} refused: {reason}")
        return JSONResponse({"reason": reason}, status_code=422)

    @app.get("/")
    def home() -> Response:
        return Response(index, media_type="text/html; charset=utf-8")

    @app.get("/page/{name}")
    def file(name: str) -> Response:
        # Only names from the table ever reach the file system.
        if name not in FILES:
            return Response(status_code=404)
        return Response((folder / name).read_bytes(), media_type=FILES[name])

    @app.get("/plotly.js")
    def plotly() -> Response:
        return Response(
            charts,
            media_type="text/javascript; charset=utf-8",
            headers={"Cache-Control": "private, max-age=3600"},
        )

    @app.get("/api/state")
    def state(log_after: int = 0) -> Any:
        return {**desk.state(), "log": desk.log_after(log_after)}

    @app.get("/api/stream")
    async def stream(request: Request) -> Response:
        """Status as server-sent events, for as long as the browser listens."""
        return StreamingResponse(_states(desk, request, over), media_type="text/event-stream")

    @app.post("/api/whatif")
    def whatif(body: WhatIfBody) -> Response:
        parts = desk.curves(parse_changes(body.changes))
        first = next(parts, None)  # what is wrong with the question is said before the answer begins
        if not isinstance(first, Curves):
            raise RefusedError("a newer question came")
        return StreamingResponse(_lines(first, parts, desk), media_type="application/x-ndjson")

    @app.post("/api/propose")
    def propose(body: WhatIfBody) -> Any:
        found = desk.propose(parse_changes(body.changes))
        return {"proposal": found.number, **found.figures}

    @app.post("/api/review")
    def review(body: ReviewBody) -> Any:
        found = desk.review(body.standing)
        return {"proposal": found.number, **found.figures}

    @app.post("/api/arm")
    def arm(body: ArmBody) -> Any:
        return {"code": desk.arm(body.proposal, body.seen_sample), "seconds": ARMED_S}

    @app.post("/api/send")
    def send(body: SendBody) -> Any:
        desk.send(body.proposal, body.code, body.seen_sample)
        return {"queued": True}

    @app.post("/api/revert")
    def revert(body: SeenBody) -> Any:
        desk.revert(body.seen_sample)
        return {"queued": True}

    @app.post("/api/on")
    def on(body: SeenBody) -> Any:
        desk.on(body.seen_sample)
        return {"queued": True}

    # Not through the thread pool, whose threads what-if may all be using: this must always get through.
    @app.post("/api/off")
    async def off() -> Any:
        """Switch control off, past the loop and whatever it waits for."""
        return {"command_id": desk.off()}

    @app.post("/api/branch")
    def branch(body: WhatIfBody) -> Any:
        sample, traces = desk.branch(parse_changes(body.changes), body.seconds)
        rate = desk.session.observer.sample_rate_hz
        return {
            "from_sample": sample,
            "step_s": BRANCH_STEP / rate,
            "seconds": body.seconds,
            "traces": [_trace(t) for t in traces or ()],
        }

    @app.post("/api/player")
    def player(body: PlayerBody) -> Any:
        desk.play(Wish(body.action, body.value))
        return {"queued": True}

    @app.get("/api/trace")
    def trace(from_sample: int, seconds: float) -> Any:
        if not 0.0 < seconds <= 5.0:
            raise RefusedError("a trace is at most 5 s long", 422)
        return {"displacement_m": desk.trace(from_sample, seconds)}

    return app


def _stand_ins(charts: bytes) -> bytes:
    """Elements that keep the charts' library from putting in style sheets that the policy would refuse.

    It brings those of its maps along, each unless an element of that name is there already; there are no maps here.
    """
    guarded = rb'getElementById\("([0-9a-f]{32,})"\)\)\{var \w+=document\.createElement\("style"\)'
    return b"".join(b'<template id="%s"></template>' % name for name in re.findall(guarded, charts))


async def _states(desk: Desk, request: Request, over: threading.Event) -> AsyncIterator[str]:
    seq = 0
    with desk.watcher():
        while not (over.is_set() or await request.is_disconnected()):
            log = desk.log_after(seq)
            seq = log[-1]["seq"] if log else seq
            yield f"data: {json.dumps({**desk.state(), 'log': log}, allow_nan=False)}\n\n"
            await asyncio.sleep(STATE_EVERY_S)


def _lines(first: Curves, parts: Iterator[Any], desk: Desk) -> Iterator[str]:
    curve = desk.damping_curve
    learned = None
    if curve is not None:
        learned = {
            "frequency_hz": [finite(f) for f in curve.frequency_hz],
            "damping_ns_m": [finite(c, 4) for c in curve.damping_ns_m],
            "std_ns_m": [finite(c, 3) for c in curve.std_ns_m],
            "in_use_ns_m": [finite(c, 4) for c in curve.in_use_ns_m],
        }
    yield _json({
        "kind": first.goal.budget_kind,
        "budget_w": first.goal.budget_w,
        "displacement_m": first.goal.displacement_m,
        "points": [_point(p, first.goal.budget_kind) for p in first.points],
        "learned": learned,
    })  # fmt: skip
    try:
        for part in parts:
            k, point = part
            yield _json({"k": k, "point": _point(point, first.goal.budget_kind)})
    except (InputError, RunError) as error:
        yield _json({"reason": str(error)})
        return
    yield _json({"done": True})


def _json(what: dict[str, Any]) -> str:
    return json.dumps(what, allow_nan=False) + "\n"


def _point(p: CurvePoint, kind: Any) -> dict[str, Any]:
    return {
        "frequency_hz": p.frequency_hz,
        "damping_ns_m": finite(p.damping_ns_m),
        "passive_m": finite(p.passive_m),
        "limit_m": finite(p.limit_m),
        "in_use": _design(p.in_use, kind),
        "proposed": None if p.proposed is None else _design(p.proposed, kind),
        "limits": [{"name": a.name, "price": finite(a.price, 3)} for a in p.active_limits],
        "reason": p.reason,
        "provisional": p.provisional,
    }


def _design(d: Design, kind: Any) -> dict[str, Any]:
    return {
        "stable": d.stable,
        "displacement_m": finite(d.displacement_m),
        "power_w": None if d.powers is None else finite(d.powers.of_kind(kind)),
        "modulus_margin": finite(d.modulus_margin),
    }


def _trace(t: BranchTrace) -> dict[str, Any]:
    def numbers(values: Any) -> list[float | None]:
        return [float(f"{v:.4g}") if math.isfinite(v) else None for v in values]

    return {
        "name": t.name,
        "displacement_m": numbers(t.displacement_m),
        "displacement_std_m": numbers(t.displacement_std_m),
        "joule_mean_w": finite(t.joule_mean_w),
        "stopped": t.stopped,
    }


class OperatorPage:
    """The page's server; a context manager that ends it, and the desk with it.

    Parameters
    ----------
    bind, port
        Where to listen; port 0 takes a free one.

    Attributes
    ----------
    url
        To be opened, with its token.
    warning
        What whoever starts it should know; empty if nothing.

    Raises
    ------
    InputError
        If it cannot listen there.
    RunError
        If the server does not come up.
    """

    def __init__(self, desk: Desk, bind: str = "127.0.0.1", port: int = 0) -> None:
        self.desk = desk
        self._over = threading.Event()
        listener = _listener(bind, port)
        port = int(listener.getsockname()[1])
        names = {"127.0.0.1", "localhost", "[::1]", f"[{bind}]" if ":" in bind else bind}
        self.warning = ""
        if not _is_loopback(bind):
            self.warning = (
                f"the operator page listens on {bind}: whoever can listen to this network can read its token and "
                "give orders; keep to the loopback interface (ssh -L) unless the network is the rig's own"
            )
        if bind in ("0.0.0.0", "::"):  # noqa: S104 - asked for by name
            names |= {socket.gethostname(), *_own_addresses()}
        shown = bind if bind not in ("0.0.0.0", "::", "") else "127.0.0.1"  # noqa: S104
        shown = f"[{shown}]" if ":" in shown else shown
        token = secrets.token_urlsafe(24)
        app = Guard(
            page_app(desk, self._over),
            token,
            {f"{name}:{port}" for name in names},
            security_policy(desk.viewer_url),
            desk.refuse,
            f"atmd{port}",
        )
        logging.getLogger("uvicorn.error").addFilter(_no_tracebacks_of_garbage)
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                log_level="error",
                lifespan="off",
                access_log=False,
                ws="none",
                server_header=False,
                timeout_keep_alive=10,
                timeout_graceful_shutdown=1,
            )
        )
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [listener]}, name="operator page", daemon=True
        )
        self._thread.start()
        self.url = f"http://{shown}:{port}/?token={token}"
        deadline = time.monotonic() + START_TIMEOUT_S
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > deadline:
                raise RunError(
                    f"the operator page's server did not start on {shown}:{port}; try another --port"
                )
            time.sleep(0.02)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()  # a browser that listens would hold the end up
        self._server.should_exit = True
        self._thread.join(5.0)
        self.desk.close()


def security_policy(viewer_url: str) -> str:
    """Content security policy: this server alone, and Rerun's viewer in a frame."""
    place = urlsplit(viewer_url)
    names = dict.fromkeys((place.hostname, "localhost"))
    frames = " ".join(f"{place.scheme}://{name}:{place.port}" for name in names) if place.netloc else "'none'"
    rules = {
        "default-src": "'none'",
        "script-src": "'self'",
        "style-src": f"'self' {EMPTY_STYLE}",
        "img-src": "'self' data:",
        "connect-src": "'self'",
        "frame-src": frames,
        "frame-ancestors": "'none'",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def _listener(bind: str, port: int) -> socket.socket:
    # The protocol is named so that connections send at once: unnamed, asyncio leaves the 40 ms of Nagle's algorithm in.
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((bind, port))
    except OSError as error:
        listener.close()
        raise InputError(
            f"the operator page cannot listen on {bind}:{port} ({error.strerror}); give another --bind or --port"
        ) from error
    return listener


def _is_loopback(bind: str) -> bool:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(bind).is_loopback
    return bind == "localhost"


def _own_addresses() -> set[str]:
    with contextlib.suppress(OSError):
        found = {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None)}
        return {f"[{a}]" if ":" in a else a for a in found}
    return set()


def _no_tracebacks_of_garbage(record: logging.LogRecord) -> bool:
    """Bytes that are no HTTP are refused by the server already; nobody wants them in the terminal."""
    return "Invalid HTTP request" not in record.getMessage()
