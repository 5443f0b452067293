"""Arguments that several verbs take, and how they are read."""

import argparse
from pathlib import Path
from typing import Any

import shtab

from hdev_jax.targets import TARGETS

__all__ = [
    "count", "effects_option", "file_argument", "log_files", "logs_and_sheet", "names", "out_options", "share",
    "split_options", "target_option",
]  # fmt: skip


def file_argument(verb: argparse.ArgumentParser, name: str, metavar: str, text: str, **options: Any) -> None:
    """An argument that a shell completes with files."""
    verb.add_argument(name, type=Path, metavar=metavar, help=text, **options).complete = shtab.FILE  # type: ignore[attr-defined]


def log_files(verb: argparse.ArgumentParser) -> None:
    """The logs, and the adapter that reads them."""
    formats = "text, Excel, Parquet, Feather, JSON lines, MATLAB, MF4, BLF or ASC"
    file_argument(verb, "logs", "LOG", f"log files ({formats}), read as one log", nargs="+")
    file_argument(verb, "--adapter", "A.toml", "how to read files whose columns have other names or units")


def logs_and_sheet(verb: argparse.ArgumentParser, *, vehicle_required: bool = True) -> None:
    """The logs, their adapter and the vehicle sheet."""
    log_files(verb)
    file_argument(
        verb, "--vehicle", "V.toml", "the vehicle sheet: what you know about the vehicle", required=vehicle_required
    )


def target_option(verb: argparse.ArgumentParser) -> None:
    """The signal to explain."""
    verb.add_argument(
        "--target", choices=tuple(TARGETS), help="the signal to explain (default: the measured one nearest the battery)"
    )


def split_options(verb: argparse.ArgumentParser) -> None:
    """The target, and which trips are for training and which are held out."""
    target_option(verb)
    verb.add_argument(
        "--train-trips",
        type=names,
        metavar="A,B",
        help="training trips; without --test-trips all others are test trips",
    )
    verb.add_argument(
        "--test-trips",
        type=names,
        metavar="C,D",
        help="held-out test trips; without --train-trips all others are for training; with neither, "
        "every third trip is held out",
    )


def effects_option(verb: argparse.ArgumentParser) -> None:
    """A file of a user's own effects."""
    file_argument(
        verb, "--effects", "FILE.py", "effects of your own, which are searched or watched for and a sheet may declare"
    )


def out_options(verb: argparse.ArgumentParser) -> None:
    """The folder for the results, and the random seed."""
    verb.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder for the results")
    verb.add_argument("--seed", type=count, default=0, metavar="N", help="random seed (default: 0)")


def names(text: str) -> tuple[str, ...]:
    """Names separated by commas."""
    found = tuple(part.strip() for part in text.split(","))
    if not all(found):
        raise argparse.ArgumentTypeError(f"expected names separated by commas, found {text!r}")
    return found


def share(text: str) -> float:
    """A number between 0 and 1."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(f"expected a number between 0 and 1, found {text!r}")
    return value


def count(text: str) -> int:
    """A whole number from 0 to 2³² − 1."""
    if not (text.isascii() and text.isdigit() and int(text) < 2**32):
        raise argparse.ArgumentTypeError(f"expected a whole number from 0 to 2^32 - 1, found {text!r}")
    return int(text)
