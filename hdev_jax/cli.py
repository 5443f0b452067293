"""`hdev`: the verbs of the toolkit on a user's own logs; each is the function of that name in `hdev_jax.verbs`.

Results go to standard output, progress and errors to standard error. Exit status 0: done, also when nothing was found;
2: the input is at fault, one line says what to do; 1: our fault; 130: interrupted.
"""

import argparse
import io
import os
import shutil
import sys
import textwrap
import traceback
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import shtab

from hdev_jax import __version__
from hdev_jax.compiling import compile_quickly, keep_compiled, level_of
from hdev_jax.errors import InputError
from hdev_jax.options.common import (
    count,
    effects_option,
    file_argument,
    log_files,
    logs_and_sheet,
    names,
    out_options,
    share,
    split_options,
    target_option,
)
from hdev_jax.options.energy import ENERGY_VERBS, energy_parsers
from hdev_jax.options.export import export_parser
from hdev_jax.options.fleet import fleet_parser
from hdev_jax.options.live import LIVE_VERBS, live_parsers

__all__ = ["FOLDERS", "main", "parser"]

FOLDERS = {
    **dict.fromkeys(ENERGY_VERBS, "energy."),
    **dict.fromkeys(LIVE_VERBS, "live."),
    "export": "programs.",
    "fleet": "many.",
}  # within `verbs`

_ABOUT = """\
Give it a measured log of an electric vehicle and a sheet of what you know about
the vehicle; it calibrates the sheet, finds what the model misses, names the
cause, adds it, and shows the error before and after."""

_EXAMPLES = """\
to begin:
  hdev demo                                     a synthetic truck's log, diagnosed: open hdev_demo/result/report.html
  hdev check trips.csv                          what was read from the log, no fit
  hdev init trips.csv                           begins trips.sheet.toml with what the log shows; for other
                                                column names trips.adapter.toml, to be filled in
  hdev diagnose trips.csv --vehicle trips.sheet.toml --out result
                                                then open result/report.html
  hdev predict new.csv --vehicle result/augmented_vehicle.toml --out new_predicted.csv

`hdev --help` lists the verbs, `hdev VERB --help` explains one. HDEV_DEBUG=1 shows the traceback of an error."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; argparse's own exits (`--help`, usage) raise SystemExit."""
    verb: str | None = None
    try:
        arguments = vars(parser().parse_args(argv))
        verb, _ = arguments.pop("verb"), arguments.pop("completion", None)
        if verb is None:
            print(f"{_ABOUT}\n\n{_EXAMPLES}")
            return 0
        _print(_run(verb, arguments))
    except KeyboardInterrupt:
        resumes = verb in ("diagnose", "calibrate", "fleet")
        return _fail("interrupted; the same command resumes" if resumes else "interrupted", 130)
    except BrokenPipeError:  # `hdev effects | head`: the reader has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except InputError as e:
        return _fail(str(e), 2)
    except Exception as e:
        what = textwrap.shorten(" ".join(f"{type(e).__name__}: {e}".split()), 300)
        return _fail(f"internal error: {what} (HDEV_DEBUG=1 shows the traceback)", 1)
    return 0


def parser() -> argparse.ArgumentParser:
    """The command line: one subparser a verb, whose options are the arguments of the function of that name."""
    top = _Parser(prog="hdev", description=_ABOUT, epilog=_EXAMPLES)
    top.add_argument("--version", action="version", version=f"hdev {__version__}")
    shtab.add_argument_to(top, "--completion", help="print a completion script for this shell, to be sourced")
    verbs = top.add_subparsers(dest="verb", metavar="VERB")

    check = verbs.add_parser(
        "check",
        help="what was read from the logs: columns, units, trips, kWh/km; no fit",
        description="Read the logs and say what is in them: columns and units, trips, what was dropped, filled or "
        "clipped and why, and the energy per km of each trip. Nothing is fitted and no file is written.",
        epilog="examples:\n  hdev check trips.csv\n  hdev check day1.csv.gz day2.csv.gz --vehicle truck.toml\n"
        "  hdev check other.mat --skeleton > adapter.toml",
    )
    logs_and_sheet(check, vehicle_required=False)
    effects_option(check)
    check.add_argument(
        "--skeleton", action="store_true", help="print an adapter for these files, to be filled in, and stop"
    )

    init = verbs.add_parser(
        "init",
        help="write a first vehicle sheet from what the log shows, or an adapter if one is needed",
        description="Write NAME.sheet.toml with what the log shows of the vehicle and typical values for the rest, "
        "with comments. Where the log's columns have other names, write NAME.adapter.toml instead, to be filled in.",
        epilog="examples:\n  hdev init trips.csv\n  hdev init other.csv --adapter other.adapter.toml",
    )
    log_files(init)
    init.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="the folder (default: this one)")

    diagnose = verbs.add_parser(
        "diagnose",
        help="calibrate, find what the model misses, add it, show the error before and after",
        description="Calibrate the vehicle on the training trips, trace the residual to effects that the sheet does "
        "not declare, add those that pass every test, and show the error before and after on held-out test trips.",
        epilog="examples:\n  hdev diagnose trips.csv --vehicle truck.toml --out result\n"
        "  hdev diagnose day*.csv --vehicle truck.toml --train-trips mon,tue --test-trips wed --out result\n\n"
        "The folder gets report.html, diagnosis.json, figures/ and augmented_vehicle.toml, a sheet with the effects\n"
        "in it. A run that was stopped resumes with the same command.",
    )
    logs_and_sheet(diagnose)
    split_options(diagnose)
    effects_option(diagnose)
    diagnose.add_argument("--only", type=names, metavar="ID,ID", help="search only these effects")
    diagnose.add_argument("--exclude", type=names, metavar="ID,ID", help="leave these effects out of the search")
    diagnose.add_argument(
        "--fdr",
        type=share,
        default=0.05,
        metavar="Q",
        help="highest FDR-adjusted p-value of an added effect (default: 0.05)",
    )
    diagnose.add_argument("--trust", action="store_true", help="search even where a unit or a sign is suspected")
    out_options(diagnose)

    calibrate = verbs.add_parser(
        "calibrate",
        help="the sheet's coefficients with their uncertainty, from the declared values and the log",
        description="Estimate the coefficients that have an sd in the sheet, with standard errors: the declared values "
        "are their priors, the training trips the data. No effect is searched.",
        epilog="examples:\n  hdev calibrate trips.csv --vehicle truck.toml --out calibrated\n"
        "  hdev calibrate trips.csv --vehicle truck.toml --method nuts --noise student_t --out drawn",
    )
    logs_and_sheet(calibrate)
    split_options(calibrate)
    effects_option(calibrate)
    calibrate.add_argument(
        "--method",
        choices=["map", "linear", "nuts"],
        default="map",
        help="map: Levenberg-Marquardt with the priors; linear: Bayesian regression in closed form; nuts: draws of the "
        "posterior, from sufficient statistics or by NUTS (default: map)",
    )
    calibrate.add_argument(
        "--noise",
        choices=["normal", "student_t"],
        default="normal",
        help="student_t: outliers count less (default: normal)",
    )
    out_options(calibrate)

    predict = verbs.add_parser(
        "predict",
        help="what a vehicle sheet predicts for each row of a log, with an interval",
        description="Predict the target for each row of the logs, and the total of each trip, with intervals. The logs "
        "need not have measured it. Give the sheet in the folder where hdev calibrate or diagnose wrote it: the "
        "covariance and the noise for the intervals are in a file beside it.",
        epilog="example:\n  hdev predict new.csv --vehicle result/augmented_vehicle.toml --out predicted.csv",
    )
    logs_and_sheet(predict)
    target_option(predict)
    effects_option(predict)
    predict.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="FILE",
        help="the file to write (.csv, .csv.gz or .parquet): trip_id, time_s, predicted, lower, upper, level",
    )
    level = "probability inside the interval (default: 0.9)"
    predict.add_argument("--level", type=share, default=0.9, metavar="P", help=level)
    predict.add_argument(
        "--online", action="store_true",
        help="take the states of loads that switch from the measured power of earlier rows",
    )  # fmt: skip

    live_parsers(verbs)

    simulate = verbs.add_parser(
        "simulate",
        help="a synthetic fleet with known truth: logs, what was true, vehicle sheets",
        description="Drive a fleet of invented trucks and buses over thousands of routes and write what their loggers "
        "would have: log.parquet and truth.parquet with a file for each vehicle, its sheet, and a report.",
        epilog="examples:\n  hdev simulate configs/studies/fleet.toml --out out/fleet\n"
        "  hdev check out/fleet/log.parquet/A.parquet --vehicle out/fleet/sheets/A.toml",
    )
    file_argument(simulate, "config", "CONFIG", "what to simulate: a TOML file with at least a seed")
    simulate.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder for the results")

    demo = verbs.add_parser(
        "demo",
        help="a synthetic truck's log with an effect that its sheet does not declare, and its diagnosis",
        description="Write a synthetic log and a sheet into a folder, diagnose them, and say what was planted.",
        epilog="example:\n  hdev demo --out tour",
    )
    demo.add_argument(
        "--out", type=Path, default=Path("hdev_demo"), metavar="DIR", help="the folder (default: hdev_demo)"
    )
    demo.add_argument("--seed", type=count, default=3, metavar="N", help="random seed of the log (default: 3)")

    energy_parsers(verbs)
    export_parser(verbs)
    fleet_parser(verbs)

    verbs.add_parser(
        "effects",
        help="the library of effects: id, stage, equation, parameters and units, channels needed",
        description="List the effects that a diagnosis searches and a vehicle sheet can declare.",
    )
    return top


class _Parser(argparse.ArgumentParser):
    """argparse with its errors on one line, no guessing of abbreviated options, and examples kept as typed."""

    def __init__(self, **options: Any):
        super().__init__(formatter_class=_Help, allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


class _Help(argparse.HelpFormatter):
    """Text with line breaks of its own is kept as it is; a single line is wrapped."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return textwrap.indent(text, indent) if "\n" in text else super()._fill_text(text, width, indent)


def _run(verb: str, arguments: dict[str, Any]) -> Any:
    if verb == "demo" or "logs" in arguments:
        level = level_of(_by_vehicle(verb, arguments.get("logs", ())))
        if level is not None:
            compile_quickly(level)
    import jax

    from hdev_jax import progress

    jax.config.update("jax_enable_x64", True)
    keep_compiled()
    with progress.shown():
        return getattr(import_module(f"hdev_jax.verbs.{FOLDERS.get(verb, '')}{verb}"), verb)(**arguments)


def _by_vehicle(verb: str, logs: Sequence[Path]) -> list[list[Path]]:
    """The files whose size decides how programs are compiled: those given; in a fleet each as if it were a vehicle."""
    if verb != "fleet":
        return [list(logs)]
    return [[f] for p in logs for f in ([p] if p.is_file() else p.rglob("*")) if f.is_file()]


def _print(result: Any) -> None:
    """The result's own text; a list of rows as a table."""
    if result is None:
        return
    rows = isinstance(result, Sequence) and not isinstance(result, str) and all(isinstance(r, Mapping) for r in result)
    sys.stdout.write((_table(result) if rows else str(result)).rstrip("\n") + "\n")
    sys.stdout.flush()


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Columns under their names. Long cells wrap on a terminal; in a pipe a row stays one line."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in rows[0] if rows else ():
        table.add_column(str(name), overflow="fold")
    for row in rows:
        cells = (", ".join(map(str, c)) if isinstance(c, list | tuple) else str(c) for c in row.values())
        table.add_row(*map(Text, cells))
    terminal = sys.stdout.isatty()
    text = io.StringIO()
    width = shutil.get_terminal_size().columns if terminal else 100_000
    Console(file=text, width=width, force_terminal=terminal, highlight=False).print(table)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())


def _fail(message: str, status: int) -> int:
    if os.environ.get("HDEV_DEBUG", "") not in ("", "0"):
        traceback.print_exc()
    print("hdev:", " ".join(message.split()), file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
