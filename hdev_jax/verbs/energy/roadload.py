"""The verb `roadload`: A, B and C of the vehicle, from driving in service or from a coast-down."""

from pathlib import Path

import numpy as np
import pandas as pd

from hdev_jax.diagnosis.candidates.own import Effects
from hdev_jax.energy.coastdown import coast_down, is_coast_down
from hdev_jax.energy.fitted import calibrated_on
from hdev_jax.energy.road_load import NAMES, SHOWN_KMH, UNITS, RoadLoad, in_service, open_sheet
from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import Sheet
from hdev_jax.logs import Log
from hdev_jax.problem import derivable, prepare
from hdev_jax.report import words
from hdev_jax.report.energy.figures import forces
from hdev_jax.report.energy.page import Page, Section, Table, span, table_of
from hdev_jax.targets import TARGETS
from hdev_jax.verbs.energy.opening import Asked, answered, synthetic
from hdev_jax.verbs.energy.result import EnergyResult, records
from hdev_jax.verbs.opening import Logs, Vehicles

__all__ = ["roadload"]


def roadload(
    logs: Logs,
    vehicle: Vehicles,
    adapter: str | Path | None = None,
    target: str | None = None,
    effects: Effects = None,
    mass: float | None = None,
    coastdown: bool = False,
    *,
    out: str | Path | None = None,
    seed: int = 0,
) -> EnergyResult:
    """Road load A + B·v + C·v² [N, N/(m/s), N/(m/s)²] with 90 % intervals, and the force at 50 and 80 km/h.

    From driving in service, c_rr, a force linear in speed and C_d·A are estimated together with the rest of the sheet.
    They come from the traction force where it is measured, else from the battery through the chain. A log in which
    nothing drives the vehicle (force or torque 0 throughout, or only time and speed) is treated as a coast-down; see
    `hdev_jax.energy.coastdown`. Notes say what the log cannot determine.

    **Arguments:** `mass` [kg] for which the road load is given; by default the log's mean, else the sheet's.
    `coastdown`: treat the log as a coast-down whatever it measures. **Returns:** an `EnergyResult` with the tables
    `road_load` and `force`. **Raises:** `InputError`.
    """
    if mass is not None and not (np.isfinite(mass) and mass > 0):
        raise InputError(f"--mass {mass}: a mass above 0 kg is expected")
    options = {"target": target, "mass": mass, "coastdown": coastdown}
    asked = Asked.of("roadload", logs, adapter, effects, seed, options)
    log, sheet = asked.log, asked.sheet(vehicle)
    if len(log.vehicle_names) > 1:
        raise InputError(f"the log has {len(log.vehicle_names)} vehicles; a road load is of one, give the log of one")
    coasting = coastdown or (target is None and is_coast_down(log))

    def work(command: str) -> EnergyResult:
        load = _coasted(log, sheet, mass) if coasting else _driven(log, sheet, target, mass, asked.seed)
        return _answer(load, sheet, log, command)

    return answered(asked, out, work)


def _mass_of(log: Log, sheet: Sheet) -> float:
    """Mean of the log's mass over the way, else the sheet's. Raises `InputError` where neither has one."""
    if log.segments.has("mass_kg"):
        mass, way = np.asarray(log.segments.channels["mass_kg"]), np.asarray(log.segments.distance_m)
        return float(np.average(mass, weights=way if way.sum() > 0 else None))
    if "mass_kg" not in sheet.declared:
        raise sheet.fail("mass_kg", "the log has no column 'mass_kg'")
    return sheet.declared["mass_kg"].value


def _coasted(log: Log, sheet: Sheet, mass: float | None) -> RoadLoad:
    rotating = sheet.declared.get("road.rotating_mass_factor")
    load = coast_down(log, _mass_of(log, sheet), 1.0 if rotating is None else rotating.value)
    notes = list(load.notes)
    if rotating is None:
        notes.append("the sheet has no road.rotating_mass_factor: 1 is taken; SAE J1263 has 1.03 where it is not known")
    if mass is not None and abs(mass / load.mass_kg - 1) > 1e-6:
        notes.append(f"A, B and C hold at the {load.mass_kg:,.0f} kg of the runs: --mass is not used")
    return RoadLoad(**{**vars(load), "notes": tuple(notes)})


def _driven(log: Log, sheet: Sheet, target: str | None, mass: float | None, seed: int) -> RoadLoad:
    at = _mass_of(log, sheet)
    nearest = "traction_force_n"
    if target is None:
        target = nearest if nearest in log.targets or derivable_here(log, sheet, nearest) else log.default_target
    opened, notes = open_sheet(sheet, at, log.segments, battery=TARGETS[target].of_battery)
    problem = prepare(log, opened, target)
    load = in_service(calibrated_on(problem), at if mass is None else mass, seed=seed)
    return RoadLoad(**{**vars(load), "notes": (*notes, *load.notes)})


def derivable_here(log: Log, sheet: Sheet, target: str) -> bool:
    """Whether the sheet has the ratios, radius and efficiency to work the target out from what is logged."""
    known = sheet.efficiency_map is not None or "driveline.efficiency" in sheet.declared
    return derivable(log, target) and known and sheet.knows_ratio(log.segments)


def _answer(load: RoadLoad, sheet: Sheet, log: Log, command: str) -> EnergyResult:
    digits = 4
    table = pd.DataFrame(
        {"coefficient": NAMES, "value": load.abc, "lower": load.lower, "upper": load.upper, "unit": UNITS}
    )
    force = pd.DataFrame(
        {"speed_kmh": load.speeds_kmh, "force_n": load.force, "lower": load.force_lower, "upper": load.force_upper,
         "driven": (load.speeds_kmh >= load.driven_kmh[0]) & (load.speeds_kmh <= load.driven_kmh[1])}
    )  # fmt: skip
    shown = [int(np.argmin(np.abs(load.speeds_kmh - v))) for v in SHOWN_KMH]
    summary = {
        "schema": "hdev-roadload/1", "how": load.how, "mass_kg": load.mass_kg, "notes": list(load.notes),
        "driven_kmh": list(load.driven_kmh), "road_load": records(table), "force": records(force),
    }  # fmt: skip
    lines = [f"road load at {load.mass_kg:,.0f} kg, {load.how}"]
    lines += [f"{n} {v:12.5g} {u:12s} {a:.5g} to {b:.5g}"
              for n, v, u, a, b in zip(NAMES, load.abc, UNITS, load.lower, load.upper, strict=True)]  # fmt: skip
    lines += [f"{v:g} km/h: {load.force[k]:.5g} N, {load.force_lower[k]:.5g} to {load.force_upper[k]:.5g}"
              for v, k in zip(SHOWN_KMH, shown, strict=True)]  # fmt: skip
    lines += [f"note: {note}" for note in load.notes]
    pieces = [(f"{n} = {words.number(v, 3, u)}", True) for n, v, u in zip(NAMES, load.abc, UNITS, strict=True)]
    answer = [p for k, piece in enumerate(pieces) for p in (((", ", False), piece) if k else (piece,))]
    answer.append((f" at {load.mass_kg:,.0f} kg on a flat road in still air.", False))
    rows = [(n, span(v, a, b), u)
            for n, v, a, b, u in zip(NAMES, load.abc, load.lower, load.upper, UNITS, strict=True)]  # fmt: skip
    whole = force.assign(speed_kmh=force["speed_kmh"].astype(int))
    page = Page(
        "roadload", sheet.name, "its road load", synthetic(log, [sheet.name]), answer,
        [(f"Force at {v:g} km/h", span(load.force[k], load.force_lower[k], load.force_upper[k], digits), "N")
         for v, k in zip(SHOWN_KMH, shown, strict=True)],
        [Section(
            "Road load",
            "Dry, straight and flat road at 20 °C, still air of the standard density, tyres as they were driven.",
            {"forces": (lambda: forces(load), "Force against speed with its interval.",
                        "Road load; what lies outside the grey band is extrapolated.")},
            (Table("Coefficients", ("Coefficient", "value (90 % interval)", "unit"), rows),
             table_of(whole, "Force", {"speed_kmh": "km/h", "force_n": "N", "lower": "from", "upper": "to"}, text=0)),
        )],
        load.notes, command, load.how,
    )  # fmt: skip
    return EnergyResult("roadload", "\n".join(lines), summary, {"road_load": table, "force": force}, page)
