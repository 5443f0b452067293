"""The parsers of the verbs about vehicles on the road: follow, serve."""

from pathlib import Path
from typing import Any

import shtab

from hdev_jax.options.common import effects_option, file_argument, target_option

__all__ = ["LIVE_VERBS", "live_parsers"]

LIVE_VERBS = ("follow", "serve")


def live_parsers(verbs: Any) -> None:
    """Add a parser for each verb to the subparsers `verbs`."""
    follow = verbs.add_parser(
        "follow",
        help="rows of a vehicle as they arrive: its energy, its coefficients, what its sheet lacks",
        description="Read rows from standard input, CSV with a header or JSON lines, in the columns of a log. Each row "
        "is predicted from the rows before it, and then updates the sheet's coefficients.",
        epilog="examples:\n  hdev follow trip.csv --vehicle truck.toml\n"
        "  tail -n +1 -f trip.csv | hdev follow --vehicle truck.toml --state truck.state\n"
        "  logger | hdev follow --vehicle truck.toml --json > estimates.jsonl\n"
        "  hdev follow --mqtt mqtt://broker.example/trucks/17 --vehicle truck.toml --state truck.state\n\n"
        "The password of a broker is read from HDEV_MQTT_PASSWORD, its user from the address: mqtt://USER@HOST/TOPIC.",
    )
    file_argument(follow, "rows", "ROWS", "a file of rows (default: standard input)", nargs="?")
    file_argument(follow, "--vehicle", "V.toml", "the vehicle sheet: what you know about the vehicle", required=True)
    file_argument(follow, "--adapter", "A.toml", "how to read rows whose columns have other names or units")
    file_argument(follow, "--state", "FILE", "keeps the estimates: the same command resumes from there")
    follow.add_argument(
        "--mqtt", metavar="URL", help="mqtt://HOST:PORT/TOPIC instead of ROWS: messages of JSON (extra mqtt)"
    )
    target_option(follow)
    effects_option(follow)
    follow.add_argument("--json", action="store_true", help="a line of JSON for each row")
    follow.add_argument(
        "--no-watch", dest="watch", action="store_false", help="do not look for effects that the sheet lacks"
    )

    serve = verbs.add_parser(
        "serve",
        help="follow many vehicles over HTTP: rows in, estimates, alarms and forecasts out, a live page",
        description="Take rows of many vehicles over HTTP, store each before it is acknowledged, follow every vehicle, "
        "and show estimates, alarms and forecasts as JSON and on a live page. Needs pip install 'hdev_jax[serve]'.",
        epilog="examples:\n  hdev serve --sheets sheets --state fleet.sqlite --tokens tokens.toml\n"
        "  hdev serve --sheets sheets --state postgresql://hdev@db.example/fleet --tokens tokens.toml\n\n"
        "The password of PostgreSQL is read from PGPASSWORD or ~/.pgpass, as by its own programs.",
    )
    serve.add_argument(
        "--sheets", type=Path, required=True, metavar="DIR",
        help="a folder of VEHICLE.toml or FLEET/VEHICLE.toml; default.toml is for vehicles without their own",
    )  # fmt: skip
    state = serve.add_argument(
        "--state", required=True, metavar="DB", help="what keeps rows and states: a file (SQLite), or postgresql://…"
    )
    state.complete = shtab.FILE  # type: ignore[attr-defined]
    tokens = 'lines of fleet = "SHA-256 of its token"; without it: one fleet, this machine only'
    file_argument(serve, "--tokens", "TOKENS.toml", tokens)
    serve.add_argument("--host", default="127.0.0.1", metavar="H", help="address to listen at (default: 127.0.0.1)")
    serve.add_argument("--port", type=int, default=8000, metavar="P", help="port to listen at (default: 8000)")
    serve.add_argument(
        "--no-watch", dest="watch", action="store_false", help="do not look for effects that the sheets lack"
    )
    effects_option(serve)
