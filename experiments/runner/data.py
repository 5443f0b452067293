"""Measured data for experiments: where it lies, and what to say where it does not."""

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path

from hdev_jax.errors import InputError

__all__ = ["ORIGIN", "MissingDataError", "data_folder", "fingerprint"]

ORIGIN = {
    "kia_niro": "github.com/FMLabSouthampton/EV_EnergyConsumptionModel_v1_2024",
    "ztbus": "doi.org/10.1038/s41597-023-02600-6",
}


class MissingDataError(InputError):
    """Measured data is not there: the message says where it is from and what to set."""


def data_folder(name: str) -> Path:
    """The folder of the data set `name` (of `ORIGIN`) under `HDEV_DATA`, by default `shared/data` beside the checkout.

    **Raises:** `MissingDataError` where it is absent or empty.
    """
    base = Path(os.environ.get("HDEV_DATA") or Path(__file__).parents[3] / "shared" / "data")
    folder = base / name
    if not folder.is_dir() or not any(folder.iterdir()):
        raise MissingDataError(
            f"no measured data in {folder}: it is from {ORIGIN[name]}; put it there, or set HDEV_DATA to the folder "
            f"that holds {name}/"
        )
    return folder


def fingerprint(paths: Iterable[str | Path]) -> str:
    """SHA-256 of the files' contents in order: a task that reads files has it among its values."""
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()
