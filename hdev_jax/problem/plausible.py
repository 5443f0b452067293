"""Would another unit of speed, slope or power fit the vehicle where the declared one does not?"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from jaxtyping import Array
from scipy.optimize import lsq_linear

from hdev_jax.inference import padded
from hdev_jax.logs.checks import Suspicion, alternatives, constant_target, mended, suspicions
from hdev_jax.physics import Vehicle
from hdev_jax.problem.problem import Problem
from hdev_jax.segments import Segments
from hdev_jax.targets import TARGETS

__all__ = ["implausible"]

ROWS = 20_000  # enough for five coefficients; whole trips from the first on
# A unit is suspected where it halves what the declared one leaves unexplained, and what then is left is small: a
# missing effect of 30 % of the power leaves 0.1, another unit 0.3 to 3.
GAIN, LEFT = 0.5, 0.25
WIDTH = 2.0  # prior standard deviations that each part of the power may be off by
LEAST_WIDTH = 0.15  # of what the sheet says it knows: masses and efficiencies are that wrong
# Of the sheet's mass, for a vehicle empty or full by the wrong sheet, which is no fault of a unit: a car's double is
# beyond what it may weigh, a truck of 16 t has 40 t when laden.
MASSES, MASSES_OF_TRUCKS = (0.7, 1.0, 1.4), (0.4, 0.6, 1.0, 1.6, 2.5)
TRUCK_KG = 4500.0
_PARTS = ("inertia", "grade", "rolling", "aero", "driveline", "auxiliary")
_WITH_MASS = ("inertia", "grade", "rolling")


@dataclass(frozen=True)
class _Other:
    """A column in another unit: what to call it, how to mend it, what to multiply by."""

    name: str
    unit: str
    factor: float


def implausible(problem: Problem, trips: tuple[int, ...] | None = None) -> tuple[Suspicion, ...]:
    """What about the log cannot be right: by itself, then for this vehicle.

    The declared vehicle's parts of the power (inertia, slope, rolling, drag, losses, auxiliaries) are scaled within
    what its sheet leaves open to fit the measured power by least squares, its mass within half and three times; where
    this fails, and fits with a column read in another unit, that unit is suspected.

    **Arguments:** `trips`, ids of those to look at, else all.
    """
    used = problem.measured if trips is None else problem.measured[problem.rows(trips)]
    if problem.log.targets and (constant := constant_target(problem.target, used)) is not None:
        return (constant,)
    found = suspicions(problem.log, target=False)
    target = TARGETS[problem.target]
    if (
        problem.vehicle.entry != "road"
        or not target.of_battery
        or any(s.what.startswith(("sign", "unit of battery", "unit of energy")) for s in found)
    ):
        return found
    s, y = _some_rows(problem, trips)
    if len(y) < 10 * len(_PARTS) or not np.any(y):
        return found
    mass_kg = s.channels["mass_kg"] if s.has("mass_kg") else problem.vehicle.mass_kg
    heavy = float(np.median(np.asarray(mass_kg))) > TRUCK_KG
    declared = _left(problem, s, y, MASSES_OF_TRUCKS if heavy else MASSES)
    best: tuple[float, _Other] | None = None
    for other in _others(problem):
        left = _left(problem, _as(s, other), y)
        if best is None or left < best[0]:
            best = (left, other)
    if best is None or best[0] > GAIN * declared or best[0] > LEFT:
        return found
    left, other = best
    if any(other.name in f.what for f in found):
        return found
    turned = other.factor == -1.0
    evidence = (
        f"{'' if turned else 'in '}{other.unit} the sheet's vehicle leaves {_percent(left)} of the measured power's "
        f"mean square unexplained; as the log is read it leaves {_percent(declared)} even at the best mass"
    )
    mend = mended(problem.log, other.name, unit=None if turned else other.unit, sign=turned)
    what = f"{'sign' if turned else 'unit'} of {other.name}"
    return (*found, Suspicion(what, evidence, mend))


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %"


def _others(problem: Problem) -> Iterator[_Other]:
    log = problem.log
    if not any(c.name == "distance_m" for c in log.columns):  # beside a distance the unit of speed shows by itself
        speeds = [c.name for c in log.columns if c.name in ("speed_mps", "speed_start_mps")][:1]
        yield from (_Other(n, unit, k) for n in speeds for unit, k in alternatives(log, n).items())
    if problem.segments.has("grade_rad") and any(c.name == "grade_rad" for c in log.columns):
        yield from (_Other("grade_rad", unit, k) for unit, k in alternatives(log, "grade_rad").items())
        yield _Other("grade_rad", "with the other sign", -1.0)


def _as(s: Segments, other: _Other) -> Segments:
    if other.name == "grade_rad":
        grade = np.arctan(np.clip(other.factor * np.tan(np.asarray(s.channels["grade_rad"])), -1.0, 1.0))
        return replace(s, channels={**s.channels, "grade_rad": grade})
    faster = s.faster(other.factor)
    if not s.has("grade_rad", "altitude_m"):
        return faster
    return faster.with_channels(grade_rad=np.asarray(s.channels["grade_rad"]) / other.factor)


def _some_rows(problem: Problem, trips: tuple[int, ...] | None) -> tuple[Segments, np.ndarray]:
    """Whole trips up to some number of rows, and their measured energy [Wh]."""
    trip = problem.log.trip
    used = np.ones(len(trip), bool) if trips is None else np.isin(trip, trips)
    rows = np.flatnonzero(used)
    if len(rows) > ROWS:
        ends = np.flatnonzero(np.diff(trip[rows], append=-1))
        rows = rows[: int(ends[min(np.searchsorted(ends, ROWS), len(ends) - 1)]) + 1][: 2 * ROWS]
    return problem.segments.take(rows), np.asarray(problem.log.target("energy_wh"))[rows]


@eqx.filter_jit
def _breakdown(vehicle: Vehicle, segments: Segments) -> dict[str, Array]:
    return vehicle.breakdown(segments)


def _left(problem: Problem, s: Segments, y: np.ndarray, masses: tuple[float, ...] = (1.0,)) -> float:
    """Share of the measured power's square that the vehicle leaves, each part scaled within what is open, at the best
    of these masses, in the sheet's."""
    breakdown = _breakdown(problem.vehicle, padded(s, y).segments)
    parts = {k: x for k, v in breakdown.items() if np.any(x := np.asarray(v)[: len(y)])}
    weight = 1.0 / np.sqrt(np.asarray(s.duration_s))
    columns, target = np.stack(list(parts.values()), axis=1) * weight[:, None], y * weight
    width = np.asarray([_width(problem, k) for k in parts])
    low = np.maximum(1.0 - width, 0.05)
    costs = []
    for mass in masses:
        A = columns * np.asarray([mass if k in _WITH_MASS else 1.0 for k in parts])
        size = np.linalg.norm(A, axis=0)
        fit = lsq_linear(A / size, target, bounds=(low * size, (1.0 + width) * size), method="bvls")
        costs.append(float(fit.cost))
    return 2.0 * min(costs) / float(target @ target)


def _width(problem: Problem, part: str) -> float:
    """By what share a part of the power may be off: what the sheet's priors leave open."""
    if part == "auxiliary":
        return 3.0
    open_ = [c.sd / abs(c.value) for c in problem.table.free if c.sd and c.value and part in _named(c.name)]
    return WIDTH * max([LEAST_WIDTH, *open_])


def _named(coefficient: str) -> tuple[str, ...]:
    return {"road.c_rr": ("rolling",), "road.cda_m2": ("aero",)}.get(coefficient, ("driveline",))
