"""The HTTP interface: FastAPI over `Fleet`. What each path takes and gives is in docs/service.md and /openapi.json."""

import asyncio
import hashlib
import hmac
import json
import threading
import time
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Annotated, Any
from urllib.parse import urlsplit

from fastapi import Depends, FastAPI, HTTPException, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import HTMLResponse, JSONResponse, StreamingResponse

from hdev_jax import __version__
from hdev_jax.errors import InputError
from hdev_jax.online.service.fleet import Fleet
from hdev_jax.online.service.given import RefusedError, checked
from hdev_jax.online.service.journal import UnavailableError

__all__ = ["HERE", "Limits", "app_of", "digest_of"]

TICK_S = 1.0  # between two events of a stream, at least
POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'"
HERE = ("127.0.0.1", "::1", "localhost")
ALONE = "fleet"  # the one fleet where no tokens are given


@dataclass(frozen=True)
class Limits:
    """What a request may have: `body` bytes, `rows`; and a fleet `rows_per_s`, with a reserve of ten seconds. Beyond
    `behind` rows that are kept and not used yet, more have to wait."""

    body: int = 4_000_000
    rows: int = 10_000
    rows_per_s: float = 20_000.0
    behind: int = 200_000


@dataclass
class _Rate:
    """A bucket of rows for each fleet, that fills by itself."""

    limits: Limits
    left: dict[str, tuple[float, float]] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def wait_s(self, fleet: str, rows: int) -> float:
        """0 where the rows may pass, else the seconds after which they would."""
        most, now = 10.0 * self.limits.rows_per_s, time.monotonic()
        with self.lock:
            left, at = self.left.get(fleet, (most, now))
            left = min(most, left + (now - at) * self.limits.rows_per_s)
            passes = rows <= left
            self.left[fleet] = (left - rows if passes else left, now)
        return 0.0 if passes else (rows - left) / self.limits.rows_per_s


def _own(request: Request) -> str:
    """The fleet whose token the request has."""
    return request.app.state.fleet_of(request)


Own = Annotated[str, Depends(_own)]


def digest_of(token: str) -> str:
    """How a token is kept: SHA-256, in hexadecimal digits."""
    return hashlib.sha256(token.encode()).hexdigest()


def app_of(fleet: Fleet, tokens: Mapping[str, str] | None = None, limits: Limits | None = None) -> FastAPI:
    """The application. `tokens`: of each fleet the digest of its token; None: one fleet, and no token is asked for."""
    limits = limits or Limits()
    rate = _Rate(limits)
    app = FastAPI(title="hdev serve", version=__version__, docs_url=None, redoc_url=None)

    def of_token(request: Request) -> str:
        if tokens is None:  # no page of another site may call, nor one under another name for this machine
            origin, host = request.headers.get("origin"), request.url.hostname
            if host not in HERE or (origin is not None and urlsplit(origin).netloc != request.url.netloc):
                raise HTTPException(403, "without tokens only this machine may call")
            return ALONE
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        given = digest_of(token) if kind.lower() == "bearer" else ""
        own = [name for name, digest in tokens.items() if hmac.compare_digest(digest, given)]
        if not own:
            raise HTTPException(
                401, "a fleet's token is expected: Authorization: Bearer …", {"WWW-Authenticate": "Bearer"}
            )
        return own[0]

    async def body_of(request: Request) -> Any:
        """The body as JSON, at most `limits.body` bytes of it."""
        if int(request.headers.get("content-length") or 0) > limits.body:
            raise HTTPException(413, f"the body has more than {limits.body} bytes; send fewer rows at a time")
        parts, size = [], 0
        async for part in request.stream():
            size += len(part)
            if size > limits.body:
                raise HTTPException(413, f"the body has more than {limits.body} bytes; send fewer rows at a time")
            parts.append(part)
        try:
            found = json.loads(b"".join(parts))
        except (ValueError, RecursionError):
            raise RefusedError(["body"], "JSON is expected") from None
        if not isinstance(found, dict):
            raise RefusedError(["body"], 'an object is expected: {"rows": […]}')
        if isinstance(found.get("rows"), list) and len(found["rows"]) > limits.rows:
            raise HTTPException(413, f"more than {limits.rows} rows; send fewer at a time")
        return found

    @app.exception_handler(RefusedError)
    async def refused(_: Request, e: RefusedError) -> JSONResponse:
        return JSONResponse({"detail": [{"loc": e.where, "msg": e.why}]}, 422)

    @app.exception_handler(InputError)
    async def faulty(_: Request, e: InputError) -> JSONResponse:
        return JSONResponse({"detail": [{"loc": ["rows"], "msg": str(e)}]}, 422)

    @app.exception_handler(UnavailableError)
    async def away(_: Request, e: UnavailableError) -> JSONResponse:  # what it says is for who runs the service
        return JSONResponse({"detail": "the database cannot be reached; send again"}, 503, {"Retry-After": "5"})

    app.state.fleet_of = of_token

    @app.post("/v1/rows")
    async def rows(request: Request, own: Own) -> dict[str, int]:
        """Rows of any vehicles of the fleet: all are kept, or none (422). The same row sent again counts once."""
        found = checked((await body_of(request)).get("rows"))
        if wait := rate.wait_s(own, len(found)):
            raise HTTPException(429, "more rows a second than this fleet may send", {"Retry-After": f"{wait:.0f}"})
        if fleet.behind >= limits.behind:
            raise HTTPException(503, f"{fleet.behind} rows are still to be used", {"Retry-After": "10"})
        return await run_in_threadpool(fleet.put, own, found)

    @app.get("/v1/vehicles")
    def vehicles(own: Own) -> list[dict[str, Any]]:
        """What is known of each vehicle of the fleet."""
        return [k for name in fleet.names(own) if (k := fleet.known(own, name)) is not None]

    def known(own: str, name: str) -> dict[str, Any]:
        found = fleet.known(own, name)
        if found is None:
            raise HTTPException(404, "this fleet has no such vehicle")
        return found

    @app.get("/v1/vehicles/{name}")
    def vehicle(name: str, own: Own) -> dict[str, Any]:
        """What is known of a vehicle, and its last rows."""
        return known(own, name) | {"recent": fleet.recent(own, name)}

    @app.get("/v1/alarms")
    def alarms(own: Own) -> list[dict[str, Any]]:
        """Vehicles whose sheet lacks an effect."""
        each = [fleet.known(own, name) for name in fleet.names(own)]
        return [{"vehicle_id": k["vehicle_id"], **k["alarm"]} for k in each if k and k["alarm"]]

    @app.post("/v1/vehicles/{name}/forecast")
    async def ahead(name: str, request: Request, own: Own) -> dict[str, Any]:
        """Energy of the rows that are sent, and what of the battery is left then."""
        await run_in_threadpool(known, own, name)
        body = await body_of(request)
        ahead_rows = body.get("rows")
        if not isinstance(ahead_rows, list) or not ahead_rows:
            raise RefusedError(["rows"], "rows to come are expected")
        checked([{**r, "vehicle_id": name, "time_s": 0.0} if isinstance(r, dict) else r for r in ahead_rows])
        battery = {k: body.get(k) for k in ("soc", "capacity_wh")} | {"reserve": body.get("reserve") or 0.0}
        for k, v in battery.items():
            if v is not None and (isinstance(v, bool) or not isinstance(v, int | float) or not 0 <= v < 1e12):
                raise RefusedError([k], "a number of 0 or more is expected")
        if body.get("capacity_wh") == 0:
            raise RefusedError(["capacity_wh"], "a number above 0 is expected")
        return await run_in_threadpool(lambda: fleet.ahead(own, name, body["rows"], **battery))

    @app.get("/v1/events")
    async def events(request: Request, own: Own) -> StreamingResponse:
        """Server-sent events: what is known of each vehicle, when it changes."""

        async def each() -> AsyncIterator[str]:
            seen, said = -1, dict[str, str]()
            while not await request.is_disconnected():
                if fleet.version != seen:
                    seen, every = fleet.version, []
                    try:
                        every = await run_in_threadpool(vehicles, own)
                    except UnavailableError:
                        seen = -1
                    for k in every:
                        line = json.dumps(k | {"recent": await run_in_threadpool(fleet.recent, own, k["vehicle_id"])})
                        if said.get(k["vehicle_id"]) != line:
                            said[k["vehicle_id"]] = line
                            yield f"data: {line}\n\n"
                yield ": \n\n"
                await asyncio.sleep(TICK_S)

        return StreamingResponse(each(), media_type="text/event-stream")

    page = files("hdev_jax.online.service").joinpath("page.html").read_text(encoding="utf-8")

    @app.get("/", include_in_schema=False)
    def front() -> HTMLResponse:
        return HTMLResponse(page, headers={"Content-Security-Policy": POLICY, "X-Frame-Options": "DENY"})

    @app.get("/healthz", include_in_schema=False)
    def healthy() -> dict[str, str]:
        return {"status": "ok"}

    return app
