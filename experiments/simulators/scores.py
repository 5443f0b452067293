"""How a simulator's log is scored: which names are right, which are false, which blame an instrument, which sizes no
vehicle has."""

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.simulators.plants import FORMS, INSTRUMENTS, PAYLOAD, PLANTS

__all__ = ["MOST", "PLAUSIBLE", "blamed", "covered", "false", "implausible", "moved", "named", "right", "sized"]

NINETY = 1.645  # standard deviations of a normal distribution to each side that hold 90 %
MOST = 3  # names of a class that still is an answer
Result = Mapping[str, Any]
Entry = Mapping[str, Any]  # `id`, `class` (as printed), `class_size`, `parameters`
# Sizes that vehicles and their instruments have, by effect and parameter. Mass: loaded by a third more or less than the
# sheet says. Gains: electric meters of classes A and B of EN 50470 are within 2 %, a current sensor in a vehicle within
# 5 %. Speed: UN Regulation 39 allows 10 % + 4 km/h, wheels wear by 3 %. Skew: a bus of 1 Hz is late by seconds.
PLAUSIBLE: Mapping[str, tuple[float, float]] = {
    "mass_scale.scale": (-0.33, 0.33), "power_gain.gain": (-0.05, 0.05), "torque_offset.gain": (-0.05, 0.05),
    "speed_scale.scale": (-0.05, 0.05), "grade_scale.scale": (-0.3, 0.3), "grade_bias.bias_rad": (-0.01, 0.01),
    "grade_noise.sd_rad": (0.0, 0.05),
    "constant_headwind.speed_mps": (-15.0, 15.0), "regen_efficiency.share": (-0.3, 1.0),
    "regen_cutoff.speed_mps": (0.0, 10.0), "rotating_mass.factor": (-0.05, 0.15), "time_skew.skew_s": (-5.0, 5.0),
    "rolling_speed.per_mps2": (0.0, 2e-5),
}  # fmt: skip
# Of coefficients, as shares of what the sheet says: rolling resistance by tyre and road, drag by trailer and load.
COEFFICIENTS: Mapping[str, tuple[float, float]] = {
    "road.c_rr": (0.5, 2.0), "road.cda_m2": (0.6, 1.6), "driveline.efficiency": (0.75, 1.15),
    "machine.motoring_efficiency": (0.75, 1.15), "machine.regenerating_efficiency": (0.0, 1.15),
    "driveline.regenerating_efficiency": (0.0, 1.15),
}  # fmt: skip


def _ids(entry: Entry) -> set[str]:
    """The names of an entry that is an answer: its own, or a class of at most three."""
    return {entry["id"], *entry["class"]} if entry["class_size"] <= MOST else {entry["id"]}


def _forms(task: Mapping[str, Any]) -> frozenset[str]:
    """What is not false in any log of this simulator: the form of its efficiency, and of its rows."""
    late = frozenset({"grade_lag", "sampling_filter", "time_skew"}) if task["rows"] == "samples" else frozenset()
    return FORMS[task["simulator"]] | late


def named(task: Mapping[str, Any], result: Result) -> bool:
    """Whether an entry holds the planted change."""
    return any(_ids(e) & PLANTS[task["plant"]].names for e in result["named"])


def moved(task: Mapping[str, Any], result: Result) -> bool:
    """Whether a declared coefficient that may take the change says so: its 90 % interval is beyond the sheet's value
    on the right side, and where the truth is a number, it is nearer to that than to the sheet's."""
    plant = PLANTS[task["plant"]]
    for k in plant.coefficients:
        if (c := result["coefficients"].get(k)) and plant.sign * (c["value"] - c["prior_value"]) > NINETY * c["sd"]:
            truth = result["truth"].get(k, c["value"])
            if abs(c["value"] - truth) < abs(c["value"] - c["prior_value"]):
                return True
    return False


def covered(result: Result) -> list[bool]:
    """Of each coefficient whose truth is a number: does its 90 % interval hold it?"""
    pairs = [(c, result["truth"][k]) for k, c in result["coefficients"].items() if k in result["truth"]]
    return [abs(c["value"] - truth) <= NINETY * c["sd"] for c, truth in pairs]


def false(task: Mapping[str, Any], named: Sequence[Entry]) -> list[str]:
    """Entries that hold neither the change nor the form of the efficiency."""
    fine = PLANTS[task["plant"]].names | _forms(task)
    return [e["id"] for e in named if not _ids(e) & fine]


def blamed(task: Mapping[str, Any], named: Sequence[Entry]) -> list[str]:
    """Of the false ones, those that say that a channel is measured wrongly, or the payload is another."""
    return [k for k in false(task, named) if k in INSTRUMENTS or k == PAYLOAD]


def right(task: Mapping[str, Any], result: Result) -> bool:
    """Whether the log says what it should.

    Nothing changed: no false name, and the form of the efficiency is named, or something is called unexplained. A
    channel missing: no false name, and something is called unexplained or that channel is said to be missing. One
    change: an entry holds it, or a declared coefficient tells it.
    """
    plant = PLANTS[task["plant"]]
    wrong = false(task, result["named"])
    if plant.missing:
        return not wrong and (result["unexplained"] or plant.missing in result["missing"])
    if not plant.names and not plant.coefficients:
        form = any(_ids(e) & _forms(task) for e in result["named"])
        return not wrong and (form or result["unexplained"] or result["two_efficiencies"])
    return named(task, result) or moved(task, result)


def sized(task: Mapping[str, Any], result: Result) -> dict[str, float] | None:
    """The change's size as found, with its 90 % interval and the truth; None where it was not found, or has no size.

    A share of regenerated power that is lost is measured from what the vehicle as fitted would recover. A coefficient
    that moves is measured by its own value, in the air that the log's density, or the standard one, stands for.
    """
    plant = PLANTS[task["plant"]]
    for e in result["named"]:
        p = e["parameters"].get(plant.parameter)
        if e["id"] in plant.names and p and p.get("interval_90"):
            truth = plant.size
            if task["plant"] == "regeneration":
                truth = 1.0 - result["recovered"] / result["recovers"]
            low, high = p["interval_90"]
            return {"true": truth, "found": p["value"], "low": low, "high": high}
    if plant.share and (c := result["coefficients"].get(plant.coefficients[0])):
        half = NINETY * c["sd"]
        truth = result["truth"][plant.coefficients[0]]
        return {"true": truth, "found": c["value"], "low": c["value"] - half, "high": c["value"] + half}
    return None


def implausible(result: Result) -> list[str]:
    """Sizes and coefficients that no vehicle has."""
    out = []
    for e in result["named"]:
        for name, p in e["parameters"].items():
            low, high = PLAUSIBLE.get(f"{e['id']}.{name}", (-float("inf"), float("inf")))
            if not low <= p["value"] <= high:
                out.append(f"{e['id']}.{name} {p['value']:.3g}")
    for name, c in result["coefficients"].items():
        low, high = COEFFICIENTS.get(name, (-float("inf"), float("inf")))
        if not low * c["prior_value"] <= c["value"] <= high * c["prior_value"]:
            out.append(f"{name} {c['value']:.3g}")
    return out
