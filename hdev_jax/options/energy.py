"""The parsers of the verbs about energy: ledger, roadload, whatif, saved, compare."""

from typing import Any

from hdev_jax.options.common import (
    effects_option,
    file_argument,
    log_files,
    logs_and_sheet,
    out_options,
    target_option,
)

__all__ = ["ENERGY_VERBS", "energy_parsers"]

ENERGY_VERBS = ("ledger", "roadload", "whatif", "saved", "compare")


def _trust(verb: Any) -> None:
    verb.add_argument("--trust", action="store_true", help="answer even where a unit or a sign is suspected")


def energy_parsers(verbs: Any) -> None:
    """Add a parser for each verb to the subparsers `verbs`."""
    ledger = verbs.add_parser(
        "ledger",
        help="where the energy goes: kWh, share and cost by cause, trip, week and vehicle",
        description="Divide the measured energy by cause (rolling, air, slope, losses, loads, each effect of the "
        "sheet) with intervals, for the whole log, each vehicle, week and trip. What no cause explains is a "
        "row of its own, so that each table adds up to the measured energy. A sheet that hdev calibrate or "
        "diagnose wrote is used as fitted; any other sheet is calibrated on this log first.",
        epilog="examples:\n  hdev ledger trips.csv --vehicle truck.toml --out where\n"
        "  hdev ledger trips.csv --vehicle result/augmented_vehicle.toml --price 0.25 --out where",
    )
    logs_and_sheet(ledger)
    target_option(ledger)
    effects_option(ledger)
    _trust(ledger)
    ledger.add_argument("--price", type=float, metavar="P", help="price of a kWh, in any currency")
    out_options(ledger)

    roadload = verbs.add_parser(
        "roadload",
        help="the vehicle's road load A + B·v + C·v² with intervals, from driving or a coast-down",
        description="Estimate A, B and C of the road load and the force at 50 and 80 km/h, with intervals: from "
        "driving in service by the sheet, or from a coast-down log (force or torque 0 throughout, or only time and "
        "speed), by time, in both directions, after SAE J1263 and J2263. Notes say what the log cannot tell.",
        epilog="examples:\n  hdev roadload trips.csv --vehicle truck.toml --out load\n"
        "  hdev roadload coasting.csv --vehicle truck.toml --coastdown --out load",
    )
    logs_and_sheet(roadload)
    target_option(roadload)
    effects_option(roadload)
    roadload.add_argument(
        "--mass", type=float, metavar="KG", help="mass for which the road load is given (default: the log's mean)"
    )
    roadload.add_argument("--coastdown", action="store_true", help="treat the log as a coast-down in any case")
    out_options(roadload)

    whatif = verbs.add_parser(
        "whatif",
        help="what a change of the vehicle, its load or the weather would cost on the trips as driven",
        description="Predict the energy of the trips as driven with a change, by trip and by cause, with intervals. A "
        "value with a sign is a change (-10%, +500), a value without one replaces the old value. Keys are those of the "
        "sheet, or channels of the log.",
        epilog="examples:\n  hdev whatif truck.toml trips.csv --set road.c_rr=-10% --out tyres\n"
        "  hdev whatif truck.toml trips.csv --set mass_kg=+500 --set ambient_temp_c=-10 --out winter",
    )
    file_argument(whatif, "vehicle", "SHEET", "the vehicle sheet")
    log_files(whatif)
    whatif.add_argument(
        "--set", dest="changes", action="append", required=True, metavar="KEY=VALUE", help="a change; may be repeated"
    )
    target_option(whatif)
    effects_option(whatif)
    _trust(whatif)
    out_options(whatif)

    saved = verbs.add_parser(
        "saved",
        help="what a change has saved, corrected for weather, load, route and speed",
        description="Calibrate the vehicle on the trips before a change (tyres, a spoiler, training of drivers) and "
        "compare the trips after it with what the unchanged vehicle would have used: the share saved with an "
        "interval, how many more trips would make it significant, and what else changed.",
        epilog="examples:\n  hdev saved trips.csv --vehicle truck.toml --before ..2024-03-31 --after 2024-04-01.. "
        "--out tyres\n"
        "  hdev saved trips.csv --vehicle truck.toml --before T01..T08 --after T09,T11,T12 --out tyres",
    )
    logs_and_sheet(saved)
    words = "first..last (dates or trips), or names of trips separated by commas"
    saved.add_argument("--before", required=True, metavar="A..B", help=f"trips before the change: {words}")
    saved.add_argument("--after", required=True, metavar="C..D", help=f"trips after the change: {words}")
    target_option(saved)
    effects_option(saved)
    _trust(saved)
    out_options(saved)

    compare = verbs.add_parser(
        "compare",
        help="where the difference between two trips, vehicles or sheets comes from",
        description="Compare two trips of a log, two of its vehicles, or two vehicle sheets on one log: the "
        "difference by cause, which adds up exactly, with intervals, and the circumstances of both.",
        epilog="examples:\n  hdev compare T01 T07 --log trips.csv --vehicle truck.toml --out why\n"
        "  hdev compare old.toml new.toml --log trips.csv --out why",
    )
    compare.add_argument("a", metavar="A", help="a trip, a vehicle of the log, or a sheet (.toml)")
    compare.add_argument("b", metavar="B", help="the other one")
    file_argument(compare, "--log", "LOG", "log files, read as one log", nargs="+", dest="logs", required=True)
    file_argument(compare, "--adapter", "A.toml", "how to read files whose columns have other names or units")
    file_argument(compare, "--vehicle", "V.toml", "the vehicle sheet, needed to compare trips or vehicles")
    target_option(compare)
    effects_option(compare)
    _trust(compare)
    out_options(compare)
