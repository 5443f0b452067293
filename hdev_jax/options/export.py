"""Arguments of the verb `export`."""

from typing import Any

from hdev_jax.options.common import effects_option, file_argument, names

__all__ = ["export_parser"]


def export_parser(verbs: Any) -> None:
    """Add the verb."""
    export = verbs.add_parser(
        "export",
        help="a vehicle sheet for other programs: compiled function, table, simulators' vehicle files",
        description="Write the vehicle of a sheet, from the road to the battery, in the format of another program. "
        "What the format cannot hold is printed, and listed with the inputs and errors in FILE.json.",
        epilog="examples:\n  hdev export truck.toml --to stablehlo --out truck.stablehlo\n"
        "  hdev export result/augmented_vehicle.toml --to lookup --out truck.csv\n"
        "  hdev export truck.toml --to sumo --out truck.add.xml",
    )
    file_argument(export, "vehicle", "SHEET", "the vehicle sheet, declared or fitted")
    export.add_argument(
        "--to",
        required=True,
        choices=["stablehlo", "onnx", "lookup", "fastsim", "sumo"],
        help="stablehlo, onnx: energy of rows as a compiled function; lookup: a table of steady consumption; fastsim, "
        "sumo: a vehicle of that simulator",
    )
    export.add_argument(
        "--channels",
        type=names,
        metavar="A,B",
        help="inputs besides duration, distance and speeds (default: slope, mass and what the sheet's effects read)",
    )
    effects_option(export)
    file_argument(export, "--out", "FILE", "the file to write; FILE.json is written beside it", required=True)
