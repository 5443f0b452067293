"""What a log alone shows: a target that never changes, the sign of the power, the size of the consumption, distance
against speed."""

import numpy as np

from hdev_jax.logs.checks.suspicion import Suspicion, mended
from hdev_jax.logs.log import Log
from hdev_jax.units import GRAVITY_MPS2

__all__ = ["COASTING", "constant_target", "suspicions"]

COASTING = "constant target 0"
"""What a log is called in which the drive does nothing: a calibration of the road load is what it is for."""

ENOUGH_M = 1000.0  # shorter, neither consumption nor correlation says anything
# Between power and (a + g·sinθ)·v: right logs of the cases and of the measured data have 0.4 to 0.98.
TURNED = -0.3
# kWh/km of the lightest vehicle gliding and the heaviest climbing; a factor of 1000 leads far beyond both
LEAST_KWHPKM, MOST_KWHPKM = 0.005, 30.0
# of the sums: odometer and speedometer differ by up to a tenth (UN R39 lets a speedometer show 10 % and 4 km/h more)
SAME = 0.12
# A counter: of its value a row adds little, and recuperation takes little back. Energy by row changes by its own size.
MANY, SMOOTH, RETURNED = 50, 0.02, 0.35
_FACTORS = {
    1.609344: "miles and kilometres",
    1.852: "nautical miles and kilometres",
    3.6: "m/s and km/h",
    1000.0: "metres and kilometres",
    3.28084: "metres and feet",
}


def constant_target(name: str, measured: np.ndarray) -> Suspicion | None:
    """A target `[row]` that has one value in every row, of more rows than chance makes: there is nothing to explain."""
    if len(measured) < MANY or np.any(measured != measured[0]):
        return None
    evidence = f"{name} is {measured[0]:.6g} in all {len(measured)} rows"
    if measured[0] != 0.0:
        return Suspicion("constant target", evidence, "name the column that was measured, or another --target")
    mend = "for a coast-down, hdev roadload --coastdown gives the road load; to diagnose, log a drive"
    return Suspicion(COASTING, evidence, mend)


def suspicions(log: Log, *, target: bool = True) -> tuple[Suspicion, ...]:
    """What about the log cannot be right, whatever the vehicle. `target`: whether its usual target is looked at too, as
    it is not where another one is in use."""
    usual = log.targets[:1] if target else ()
    for constant in (constant_target(name, log.target(name)) for name in usual):
        if constant is not None:
            return (constant,)
    if (counter := _counter(log)) is not None:  # of the others' evidence the energy is a part
        return (counter,)
    found = (_sign(log), _consumption(log), _distance(log))
    return tuple(s for s in found if s is not None)


def _measured(log: Log) -> tuple[str, np.ndarray] | None:
    """The measured column at the battery, and power by row [W]."""
    if not log.measured:
        return None
    return next(iter(log.measured)), 1e3 * log.target("battery_power_kw")


def _counter(log: Log) -> Suspicion | None:
    """Energy that is large beside its change from row to row, and hardly ever turns: a counter."""
    x = log.measured.get("energy_wh")
    if x is None:
        return None
    trip = np.asarray(log.segments.trip)
    step = np.diff(x)[trip[1:] == trip[:-1]]
    if len(step) < MANY:
        return None
    value, change = float(np.median(np.abs(x))), float(np.median(np.abs(step)))
    if value == 0.0 or change > SMOOTH * value or not np.any(step):
        return None
    if min(float(np.mean(step > 0)), float(np.mean(step < 0))) > RETURNED:
        return None
    evidence = f"{value:.4g} Wh in the median row, changing by {change:.2g} Wh: a counter?"
    mend = mended(log, "energy_wh").replace(" }", ", counter = true }")
    return Suspicion("energy_wh", evidence, mend)


def _sign(log: Log) -> Suspicion | None:
    if (measured := _measured(log)) is None:
        return None
    name, power = measured
    s = log.segments
    v = np.asarray(s.speed_mps)
    pull = (np.asarray(s.speed_end_mps) - np.asarray(s.speed_start_mps)) / np.asarray(s.duration_s)
    if "grade_rad" in s.channels:
        pull = pull + GRAVITY_MPS2 * np.sin(np.asarray(s.channels["grade_rad"]))
    x = pull * v
    if float(np.sum(s.distance_m)) < ENOUGH_M or np.std(x) == 0 or np.std(power) == 0:
        return None
    r = float(np.corrcoef(x, power)[0, 1])
    if r > TURNED:
        return None
    kwh, km = float(np.sum(power * np.asarray(s.duration_s))) / 3.6e6, float(np.sum(s.distance_m)) / 1e3
    evidence = f"it falls where the vehicle accelerates or climbs (correlation {r:.2f}), {kwh:.3g} kWh over {km:.3g} km"
    return Suspicion(f"sign of {name}", evidence, mended(log, name, sign=True))


def _consumption(log: Log) -> Suspicion | None:
    if (measured := _measured(log)) is None:
        return None
    name, power = measured
    s = log.segments
    metres = float(np.sum(s.distance_m))
    if metres < ENOUGH_M:
        return None
    drawn = float(np.sum(np.abs(power) * np.asarray(s.duration_s))) / 3600.0 / metres  # Wh/m = kWh/km
    if LEAST_KWHPKM <= drawn <= MOST_KWHPKM:
        return None
    column = next((c for c in log.columns if c.name == name), None)
    told = column.unit if column is not None else ""
    small = drawn < LEAST_KWHPKM
    up = {"W": "kW", "w": "kW", "Wh": "kWh", "wh": "kWh", "": "kW" if name.endswith("_w") else "kWh"}
    down = {"kW": "W", "kw": "W", "kWh": "Wh", "kwh": "Wh"}
    unit = (up if small else down).get(told)
    evidence = f"{drawn:.3g} kWh/km drawn and returned, {LEAST_KWHPKM:g} to {MOST_KWHPKM:g} are possible"
    return Suspicion(f"unit of {name}", evidence, mended(log, name, unit=unit or "?"))


def _distance(log: Log) -> Suspicion | None:
    """Of a logged distance: by trips, whose median ratio to speed × duration is that of two units."""
    if not any(c.name == "distance_m" for c in log.columns):
        return None
    s = log.segments
    trip = np.asarray(s.trip)
    way = np.bincount(trip, np.asarray(s.distance_m))
    speed = 0.5 * (np.asarray(s.speed_start_mps) + np.asarray(s.speed_end_mps))
    made = np.bincount(trip, speed * np.asarray(s.duration_s))
    long = made > ENOUGH_M / 10
    if not long.any():
        return None
    ratio = float(np.median(way[long] / made[long]))
    if abs(ratio - 1.0) < SAME:
        return None
    for factor, what in _FACTORS.items():
        for k in (factor, 1.0 / factor):
            if abs(ratio / k - 1.0) < 0.03:
                evidence = f"the distance is {ratio:.4g} times speed × duration, as between {what}"
                mend = "correct the unit of distance_m or of the speed in an adapter: { source = …, unit = … }"
                return Suspicion("unit of distance_m or speed", evidence, mend)
    return None
