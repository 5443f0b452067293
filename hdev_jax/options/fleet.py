"""The parser of the verb `fleet`."""

import argparse
from pathlib import Path
from typing import Any

from hdev_jax.options.common import effects_option, file_argument, out_options, share, target_option

__all__ = ["fleet_parser"]


def fleet_parser(verbs: Any) -> None:
    """Add the parser to the subparsers `verbs`."""
    fleet = verbs.add_parser(
        "fleet",
        help="many vehicles: each diagnosed, effects and coefficients pooled by type, which differ, an energy ledger",
        description="Check, calibrate and diagnose every vehicle, then compare them: effects that no single log is "
        "enough to name, coefficients by type, vehicles that differ from their type or have changed, with the date, "
        "and where the energy goes. A vehicle with a bad log gets a line in the result. A run that was stopped "
        "resumes with the same command.",
        epilog="examples:\n  hdev fleet logs/ --vehicles sheets/ --out fleet\n"
        "  hdev fleet logs/ --vehicles truck.toml --workers 4 --price 0.25 --out fleet\n"
        "  hdev fleet logs.parquet --vehicles vehicles.csv --scheduler tcp://10.0.0.1:8786 --out fleet",
    )
    text = "folders with a log (or a folder of files, A/ or vehicle_id=A/) for each vehicle, or log files"
    fleet.add_argument("logs", type=Path, metavar="LOGS", nargs="+", help=text)
    file_argument(
        fleet, "--vehicles", "SHEETS", "a folder of sheets A.toml, one sheet, or a CSV table vehicle,sheet[,type]",
        required=True,
    )  # fmt: skip
    file_argument(fleet, "--adapter", "A.toml", "how to read files whose columns have other names or units")
    target_option(fleet)
    effects_option(fleet)
    fleet.add_argument("--price", type=float, metavar="P", help="price of a kWh, in any currency")
    fleet.add_argument(
        "--fdr", type=share, default=0.05, metavar="Q",
        help="highest FDR-adjusted p-value, in each vehicle and over the fleet (default: 0.05)",
    )  # fmt: skip
    fleet.add_argument("--trust", action="store_true", help="search even where a unit or a sign is suspected")
    where = fleet.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=_workers, default=1, metavar="N", help="processes (default: 1; more need Dask)"
    )
    where.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler's address, or its file")
    out_options(fleet)


def _workers(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 10_000):
        raise argparse.ArgumentTypeError(f"expected a number of processes, found {text!r}")
    return int(text)
