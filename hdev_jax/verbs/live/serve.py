"""The verb `serve`: many vehicles followed behind HTTP."""

import socket
import tomllib
from pathlib import Path

from hdev_jax import progress
from hdev_jax.diagnosis.candidates.own import known_effects
from hdev_jax.errors import InputError
from hdev_jax.online.service import Fleet, Journal, sheets_in
from hdev_jax.verbs.opening import digest_of_effects

__all__ = ["serve"]

EXTRA = "hdev serve needs FastAPI and uvicorn: pip install 'hdev_jax[serve]'"


def serve(
    sheets: str | Path,
    state: str | Path,
    tokens: str | Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8000,
    watch: bool = True,
    effects: str | Path | None = None,
) -> None:
    """Take rows of many vehicles over HTTP and return estimates, alarms and forecasts. Runs until it is stopped.

    **Arguments:**

    - `sheets`: a folder with VEHICLE.toml or FLEET/VEHICLE.toml; `default.toml` is the sheet of all other vehicles.
    - `state`: where rows and states are stored, an SQLite file or `postgresql://…`.
    - `tokens`: a TOML file with a line `fleet = "SHA-256 of its token"` for each fleet. Without it there is one fleet,
      and only this machine may call.
    - `watch`: name effects of the library that a sheet lacks.
    - `effects`: a Python file of your own effects, which are watched too and which a sheet may declare.

    **Raises:** `InputError`.
    """
    try:
        import uvicorn

        from hdev_jax.online.service.app import HERE, app_of
    except ImportError as e:
        raise InputError(EXTRA) from e
    if tokens is None and host not in HERE:
        raise InputError(f"--host {host}: other machines may call only where --tokens says which fleets there are")
    digests = None if tokens is None else _tokens(Path(tokens))
    sheet_for = sheets_in(sheets) if effects is None else sheets_in(sheets, known_effects(effects))
    with _bound(host, port) as at:  # before the journal: a second start by mistake must not take it from the first
        fleet = Fleet(Journal(state), sheet_for, watch=watch, effects_sha256=digest_of_effects(effects))
        progress.step(f"http://{host}:{port}/ shows the vehicles; rows go to /v1/rows")
        try:
            app = app_of(fleet, digests)  # a page that is open listens for ever: it is cut off
            uvicorn.Server(uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=2)).run([at])
        finally:
            fleet.close()


def _bound(host: str, port: int) -> socket.socket:
    """The address to listen at. Raises `InputError` where another program has it."""
    at = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        at.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        at.bind((host, port))
        at.listen()  # two may be bound, one alone listens
    except (OSError, OverflowError) as e:
        at.close()
        raise InputError(
            f"--host {host} --port {port}: cannot listen there ({getattr(e, 'strerror', None) or e})"
        ) from e
    return at


def _tokens(path: Path) -> dict[str, str]:
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as e:
        raise InputError(f"--tokens {path}: cannot be read ({e})") from e
    for name, digest in found.items():
        if not (isinstance(digest, str) and len(digest) == 64 and set(digest) <= set("0123456789abcdef")):
            raise InputError(f"--tokens {path}: {name}: the SHA-256 of a token, 64 hexadecimal digits, is expected")
    if not found:
        raise InputError(f"--tokens {path}: names no fleet; fleet = 'SHA-256 of its token' is expected")
    return found
