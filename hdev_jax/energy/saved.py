"""What a change saved: trips after it against the vehicle calibrated on trips before it.

Weather, load, route and speed are the kernel's inputs, so what they change is in the prediction and not in the saving.
Of the trips after the change, r measured less predicted and p predicted [kWh] by trip:

    r = −s·p + u,   Var u = diag(noise of each trip) + X Σ Xᵀ

s the share saved, the noise of a trip with a random intercept of its own (`Spread`, from trips before the change by
leaving each out), Σ the covariance of the coefficients and X what each adds to a trip. s is the generalised
least-squares estimate; its variance is scaled by how the trips after scatter about it, and its Student t has the
degrees of freedom of both.
"""

import datetime
import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

from hdev_jax.energy.fitted import LEVEL, Fitted
from hdev_jax.errors import InputError
from hdev_jax.inference import linearised, padded
from hdev_jax.logs import Log
from hdev_jax.logs.adapter import near
from hdev_jax.physics.loads import STANDSTILL_MPS
from hdev_jax.problem import Problem

__all__ = ["LEAST_TRIPS", "Saving", "circumstances", "conditions", "saving", "trips_of"]

LEAST_TRIPS = 2  # on either side
POWER = 0.8  # chance with which further trips are to show the saving as estimated: the usual one of planning
DIFFERS = 0.5  # standard deviations of trips: a difference of medium size (Cohen, Statistical Power Analysis, 1988)


@dataclass(frozen=True)
class Saving:
    """Energy saved by a change, as a `share` of what the vehicle as it was before would have taken on the trips after
    it (`expected_kwh`), with its 90 % interval.

    `freedom` of its Student t; `trips`, a row for each trip after the change: expected, measured, saved, with interval;
    `more_after`, further trips after the change that would show it (80 % chance), 0 where it is shown, None where no
    number would because the trips before leave too much open; `least_share`, the smallest saving that these would show
    then; `more_both`, as many further trips before and after, in a trial that is planned anew.
    """

    share: float
    lower: float
    upper: float
    freedom: float
    expected_kwh: float
    trips: pd.DataFrame
    more_after: int | None
    more_both: int
    least_share: float

    @property
    def shown(self) -> bool:
        """Whether the interval is on one side of 0."""
        return self.lower > 0 or self.upper < 0


def trips_of(log: Log, text: str, option: str) -> tuple[int, ...]:
    """Trips by a list of names, `A,B,C`, or a range with two dots: of dates (`2024-03-01..2024-03-31`, both days
    included), else of trips in the order of the log (`T01..T08`); either end may be left open.

    **Raises:** `InputError` for a name that is none, dates in a log without, and a range that holds no trip.
    """
    there = [i for i in range(len(log.trip_names)) if np.any(log.trip == i)]
    if ".." not in text:
        return tuple(dict.fromkeys(log.trip_id(name.strip()) for name in text.split(",") if name.strip()))
    first, _, last = (part.strip() for part in text.partition(".."))
    named = [x for x in (first, last) if x in log.trip_names]
    other = [x for x in (first, last) if x and x not in named]
    dates = [None if x in named else _date(x) for x in (first, last)]
    for x in other:
        if _date(x) is None:
            if x[0].isdigit() and not near(x, log.trip_names):
                raise InputError(f"{option} {text}: {x} is no trip of the log and no day; 2024-03-31 is expected")
            log.trip_id(x)
    if other:
        if named:
            raise InputError(f"{option} {text}: {named[0]} is a trip and {other[0]} a day; two of a kind are expected")
        if not log.started_s:
            raise InputError(f"{option} {text}: the log's clock has no date; name trips, T01..T08 or T01,T02")
        low = dates[0] if dates[0] is not None else -math.inf
        high = dates[1] + 86_400.0 if dates[1] is not None else math.inf
        found = tuple(i for i in there if low <= log.started_s.get(log.trip_names[i], math.nan) < high)
    else:
        ends = log.trip_id(first) if first else 0, log.trip_id(last) if last else len(log.trip_names) - 1
        found = tuple(i for i in there if ends[0] <= i <= ends[1])
    if not found:
        raise InputError(f"{option} {text}: no trip of the log is in this range; hdev check lists them")
    return found


def _date(text: str) -> float | None:
    """Seconds since 1970 of a day's start; None for what is no day."""
    try:
        day = datetime.date.fromisoformat(text)
        return datetime.datetime.combine(day, datetime.time(), datetime.UTC).timestamp()
    except ValueError:
        return None


def saving(fitted: Fitted, after: tuple[int, ...], *, level: float = LEVEL) -> Saving:
    """The saving on these trips by the vehicle `fitted` on others. Raises `InputError` for fewer than two trips."""
    problem = fitted.problem
    if len(after) < LEAST_TRIPS or fitted.spread is None:
        raise InputError(f"--after: {len(after)} trip; at least {LEAST_TRIPS} are expected")
    predicted, measured = (fitted.by_trip(y)[list(after)] for y in (fitted.predicted, problem.measured))
    x = _slopes(fitted)[list(after)]
    own = fitted.noise_kwh()[list(after)] ** 2
    r, opened = measured - predicted, x @ fitted.covariance @ x.T
    inverse = np.linalg.inv(np.diag(own) + opened)
    information = float(predicted @ inverse @ predicted)
    weight = inverse @ predicted / information
    share = -float(weight @ r)
    left = r + share * predicted
    before = fitted.spread.total_freedom
    freedom = before + len(after) - 1.0
    scale = (before + float(left @ inverse @ left)) / freedom
    se = math.sqrt(scale / information)
    half = float(stats.t.ppf(0.5 + level / 2, freedom)) * se
    alone = np.sqrt(scale * (own + np.diag(opened)))
    reach = float(stats.t.ppf(0.5 + level / 2, freedom))
    trips = pd.DataFrame(
        {
            "trip_id": [problem.log.trip_names[i] for i in after],
            "expected_kwh": predicted,
            "measured_kwh": measured,
            "saved_kwh": -r,
            "lower": -r - reach * alone,
            "upper": -r + reach * alone,
        }
    )
    noise, coefficients = scale * float(weight**2 @ own), scale * float(weight @ opened @ weight)
    more_after, more_both, least = _further(share, noise, coefficients, len(after), level)
    if share - half > 0 or share + half < 0:
        more_after = more_both = 0
    return Saving(
        share, share - half, share + half, freedom, float(predicted.sum()), trips, more_after, more_both, least
    )


def _further(
    share: float, noise: float, coefficients: float, trips: int, level: float
) -> tuple[int | None, int, float]:
    """Further trips after the change alone, further ones on both sides, and the smallest share that could be shown."""
    reach = float(stats.norm.ppf(0.5 + level / 2) + stats.norm.ppf(POWER))
    least = reach * math.sqrt(coefficients)
    both = math.ceil(trips * max(reach**2 * (noise + coefficients) / max(share**2, 1e-12) - 1.0, 0.0))
    room = (share / reach) ** 2 - coefficients
    return (math.ceil(trips * max(noise / room - 1.0, 0.0)) if room > 0 else None), both, least


def _slopes(fitted: Fitted) -> Float[np.ndarray, "trip free"]:
    """Derivative of each trip's energy in the free coefficients [kWh]."""
    problem = fitted.problem
    rows = padded(problem.segments, problem.measured)
    _, slopes = linearised(fitted.vehicle, problem.table, rows.segments, problem.target)
    each = [fitted.by_trip(s) for s in slopes[: rows.rows].T]
    return np.stack(each, axis=1) if each else np.zeros((len(problem.log.trip_names), 0))


def circumstances(problem: Problem, before: tuple[int, ...], after: tuple[int, ...]) -> pd.DataFrame:
    """What else changed: means of trips before and after, their difference in standard deviations of trips
    (`difference_sd`, pooled), and whether it is large (`differs`)."""
    each = conditions(problem)
    rows = []
    for name, (unit, x) in each.items():
        a, b = x[list(before)], x[list(after)]
        a, b = a[np.isfinite(a)], b[np.isfinite(b)]
        if not len(a) or not len(b):
            continue
        pooled = math.sqrt((np.var(a, ddof=1) + np.var(b, ddof=1)) / 2) if min(len(a), len(b)) > 1 else math.nan
        moved = float(np.mean(b) - np.mean(a))
        size = moved / pooled if pooled > 0 else (0.0 if moved == 0 else math.nan)
        rows.append((name, unit, float(np.mean(a)), float(np.mean(b)), size, bool(abs(size) > DIFFERS)))
    return pd.DataFrame(rows, columns=["what", "unit", "before", "after", "difference_sd", "differs"])


def conditions(problem: Problem) -> dict[str, tuple[str, np.ndarray]]:
    """Of each trip: speeds, stops, slope, load, weather, its length; NaN where it has none."""
    log, s = problem.log, problem.segments
    n, trip = len(log.trip_names), problem.log.trip
    seconds, meters, v = np.asarray(s.duration_s), np.asarray(s.distance_m), np.asarray(s.speed_mps)

    def total(x: np.ndarray) -> np.ndarray:
        return np.bincount(trip, weights=x, minlength=n)

    moves = v >= STANDSTILL_MPS
    with np.errstate(invalid="ignore", divide="ignore"):
        km = total(meters) / 1e3
        begins = np.r_[False, moves[1:] & ~moves[:-1] & (trip[1:] == trip[:-1])]
        found = {
            "speed in motion": ("km/h", 3.6 * total(meters * moves) / total(seconds * moves)),
            "stops per km": ("1/km", total(begins.astype(float)) / km),
            "change of speed": ("m/s²", total(np.abs(np.asarray(s.accel_mps2)) * seconds) / total(seconds)),
            "length": ("km", np.where(km > 0, km, np.nan)),
        }
        if s.has("grade_rad"):
            grade = np.asarray(s.channels["grade_rad"])
            found["climb less descent"] = ("m/km", total(np.sin(grade) * meters) / km)
            found["up and down"] = ("m/km", total(np.abs(np.sin(grade)) * meters) / km)
        for channel, name, unit, k in (
            ("mass_kg", "mass", "t", 1e-3), ("ambient_temp_c", "outside temperature", "°C", 1.0),
            ("wind_speed_mps", "wind", "m/s", 1.0), ("wet_road", "wet road", "1", 1.0),
        ):  # fmt: skip
            if s.has(channel):
                found[name] = (unit, k * total(np.asarray(s.channels[channel]) * seconds) / total(seconds))
    return found
