"""XML of a traffic simulation: vehicles with attributes, step by step of the simulated time, as SUMO writes them."""

import io
from array import array
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from hdev_jax.errors import InputError
from hdev_jax.logs.ledger import Ledger

__all__ = ["STEP", "read_steps"]

STEP = "step"
"""The column of a row's length [s]: an attribute of no vehicle, but the usual time from one step to the next."""

_ENERGIES = ("energyConsumed", "totalEnergyConsumed", "totalEnergyRegenerated")
_NEEDED = (*_ENERGIES, "speed", "acceleration", "slope", "mass", "posOnLane", "Consum")
_SAME = 0.01  # of the sums: attributes are written with two digits behind the point
_MISSING = 0.05  # beyond, it is no matter of digits or of a full battery


def read_steps(path: Path, data: bytes) -> tuple[pd.DataFrame, Ledger]:
    """A row for each vehicle and step: `time`, `step`, `id` and the attributes that are numbers; vehicle by vehicle.

    Raises `InputError` where the file is damaged, or no XML of that form.
    """
    numbers: dict[str, array] = {}
    texts: dict[str, int] = {}
    times, ids = array("d"), []
    for time, vehicle in _vehicles(path, data):
        name = vehicle.get("id")
        if name is None:
            raise InputError(f"{path}: a vehicle without an id at time {time:g} s")
        for key, value in vehicle.items():
            if key == "id" or key in texts:
                continue
            try:
                number = float(value.replace("_", "?"))  # the lane 12_0 is no number
            except ValueError:
                if key in _NEEDED:
                    raise InputError(
                        f"{path}: vehicle '{name}' at time {time:g} s: {key} = '{value}', a number is expected"
                    ) from None
                numbers.pop(key, None)  # once a text, never a number
                texts[key] = len(ids)
                continue
            column = numbers.setdefault(key, array("d"))
            column.extend([np.nan] * (len(ids) - len(column)))
            column.append(number)
        times.append(time)
        ids.append(name)
    if not ids:
        raise InputError(f"{path}: no vehicle in any step")
    if "aggregateNumber" in numbers:
        raise InputError(f"{path}: steps that were put together; the output of the simulation itself is needed")
    table = pd.DataFrame({"time": np.array(times), "id": ids})
    for key, column in numbers.items():
        table[key] = np.r_[np.array(column), np.full(len(ids) - len(column), np.nan)]
    moments = np.unique(table["time"].to_numpy())
    step = float(np.median(np.diff(moments))) if len(moments) > 1 else np.nan
    table.insert(1, STEP, step)
    order = np.argsort(pd.factorize(table["id"])[0], kind="stable")
    table = table.iloc[order].reset_index(drop=True)
    ledger = Ledger().add("noted", f"{len(set(ids))} vehicles in {len(moments)} steps of {step:g} s", file=path.name)
    if texts:
        ledger = ledger.add("noted", f"attributes that are texts, left out: {', '.join(texts)}", file=path.name)
    return table, _checked(table, ledger, path.name)


def _vehicles(path: Path, data: bytes) -> Iterator[tuple[float, ElementTree.Element]]:
    """Each vehicle's element with the time of its step [s]; what has been read is forgotten."""
    try:
        steps = ElementTree.iterparse(io.BytesIO(data), events=("start", "end"))
        _, root = next(steps)
        time: float | None = None
        for event, element in steps:
            if event == "start" and element.tag == "timestep":
                time = float(element.attrib["time"])
            elif event == "end" and element.tag == "vehicle":
                if time is None:
                    raise InputError(f"{path}: <vehicle> outside of a <timestep>")
                yield time, element
            elif event == "end" and element.tag == "timestep":
                root.clear()
        if time is None:
            raise InputError(f"{path}: <{root.tag}> without <timestep>: only SUMO's vehicles by time step are read")
    except (ElementTree.ParseError, StopIteration) as e:
        raise InputError(f"{path}: truncated or damaged XML file ({e})") from None
    except (ValueError, KeyError) as e:
        raise InputError(f"{path}: a <timestep> without a time, or one that is no number ({e})") from None


def _checked(table: pd.DataFrame, ledger: Ledger, file: str) -> Ledger:
    """Where the battery's totals are there too, the rows' energies add up to them: not so where steps are left out."""
    if not set(_ENERGIES) <= set(table.columns):
        return ledger
    row, drawn, returned = (table.groupby("id", sort=False)[c] for c in _ENERGIES)
    total = (drawn.last() - returned.last()) - (drawn.first() - returned.first())
    rows = row.sum() - row.first()
    away = float(np.abs(rows - total).sum())
    allowed = float(np.abs(total).sum()) + len(table)
    if away <= _SAME * allowed:
        return ledger
    why = f"the rows add up to {rows.sum():.5g} Wh, the totals to {total.sum():.5g} Wh"
    if away > _MISSING * allowed:
        raise InputError(f"{file}: {why}: it leaves steps out, whose energy is unknown; write every step")
    return ledger.add("noted", why, file=file, column=_ENERGIES[0])
