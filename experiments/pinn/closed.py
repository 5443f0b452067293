"""The kernel with a list of effects, by closed form on a vehicle's training rows; what networks take over from it.

Sizes are linear, or nearly, and have a closed form. A threshold (where a battery stops charging, how late a reading is)
is not: it is searched between closed forms of all else. A trip's mass is off by its own share.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import NamedTuple

import equinox as eqx
import numpy as np

from experiments.paper1.halves import MASS_SD, coefficient, fitted
from experiments.pinn.data import Data, Member, weighed
from hdev_jax.inference import (
    Fit,
    LinearFit,
    ParameterTable,
    Rows,
    effect_coefficients,
    jacobian,
    linear_fit,
    padded,
    predict,
)
from hdev_jax.learn.pinn.model import Sized
from hdev_jax.learn.pinn.rows import row_wise
from hdev_jax.physics import LIBRARY, Effect, Parameter, Size, Switch, Vehicle, at_null, most_group
from hdev_jax.segments import Segments

__all__ = ["Closed", "closed", "kernel", "listed", "opened", "said", "sized", "trainable"]

_ROUNDS = 5  # of a search: the threshold's grid, then each time a quarter of the steps about the best
_LEAST_TRIPS = 4  # whose masses have a variance
_LEAST_GAIN = 10.0  # variances of the noise: what a threshold has to take off the sum of squares


def trainable(effects: Iterable[str]) -> tuple[str, ...]:
    """Those whose sizes a network may train: they have some, no threshold, and act within a row."""
    kinds = {e: {type(p) for p in LIBRARY[e].parameters} for e in effects}
    return tuple(e for e, k in kinds.items() if Size in k and Switch not in k and row_wise(LIBRARY[e]))


def sized(effects: Mapping[str, Mapping[str, float]]) -> tuple[Sized, ...]:
    """Effects by id as a network trains them: shapes as they are given, sizes that are not given are trained."""
    out = []
    for id, given in effects.items():
        kind = LIBRARY[id]
        groups = {"": 0, "road_surface": 4, "gear": 13}
        sizes = tuple((p.name, groups[p.by]) for p in kind.parameters if isinstance(p, Size) and p.name not in given)
        fixed = tuple((p.name, float(given.get(p.name, p.null))) for p in kind.parameters
                      if p.name not in dict(sizes))  # fmt: skip
        out.append(Sized(kind, sizes, fixed))
    return tuple(out)


def said(vehicle: Vehicle, m: Member, segments: Segments | None = None) -> np.ndarray:
    """Energy of every row of a vehicle by the kernel [Wh]; of `segments` in the place of its log."""
    rows = padded(m.segments if segments is None else segments, m.energy_wh, _whole(len(m.use)))
    return np.asarray(predict(vehicle, rows.segments, "energy_wh"))[: rows.rows]


def _whole(n: int, least: int = 1) -> int:
    """The next power of two: vehicles of about as many rows, or trips, share what is compiled, which takes longest."""
    return 2 ** int(np.ceil(np.log2(max(n, least))))


class Closed(NamedTuple):
    """A vehicle's kernel in closed form, and that form; by how much each row's mass is off (0 where the trip is not
    trained on) and the standard deviation of that over trips, as shares of the logged mass (NaN: too few trips to tell;
    0: the mass is as it is given)."""

    vehicle: Vehicle
    fit: LinearFit
    payload: np.ndarray
    payload_sd: float
    size: int  # as in `padded`, of the training rows

    def weighed(self, m: Member) -> Segments:
        """The vehicle's log with its trips' masses as they were found."""
        return weighed(m.segments, self.payload)

    def again(self, m: Member, values: np.ndarray) -> LinearFit:
        """The same training rows with the kernel linearised at other values of its coefficients."""
        train = m.where(0)
        rows = padded(self.weighed(m).take(train), m.energy_wh[train], self.size)
        of, table = np.zeros(len(train), int), self.fit.table
        return linear_fit(
            self.vehicle, table, lambda: [Rows(rows, of)], "energy_wh", passes=1, prior=(values, self.fit.scale)
        )


def kernel(m: Member, effects: Mapping[str, Mapping[str, float]], *, rows: int = 1, trips: int = 1) -> Closed:
    """The whole kernel, efficiency map included, with these effects; parameters that are not given are fitted to the
    training rows. A shape that is not given has its usual value.

    Sizes in closed form, thresholds by search between, and where the mass is among the effects what each trip's is off
    by about the mean: a random effect of the trips, whose variance is estimated from them (EM; Laird and Ware 1982).
    Otherwise a few trips that are heavier than logged would be taken for drag and rolling resistance. `rows` and
    `trips`: what other vehicles have, so that they share what is compiled.
    """
    train = m.where(0)
    size = _whole(len(train), rows)
    segments, energy = m.segments.take(train), m.energy_wh[train]
    row_s = float(np.median(np.asarray(segments.duration_s)))
    car, table = listed(m, effects)
    searches = [
        _Search(id, p, row_s)
        for id, given in effects.items()
        for p in LIBRARY[id].parameters
        if isinstance(p, Switch) and p.name not in given
    ]
    limits = {f"effects.{s.id}.{s.p.name}": True for s in searches}
    loose = "scale" in opened(effects, "mass_scale") and segments.has("mass_kg")
    masses = _Trips.of(segments, trips) if loose else None

    def fit(car: Vehicle, s: Segments) -> tuple[Vehicle, LinearFit]:
        found = fitted(car, table, s, energy, "energy_wh", paper=True, size=size)
        return table.insert(car, found.values), found

    car, found = fit(car, segments)
    for _ in range(_ROUNDS if searches or masses else 0):
        now = segments if masses is None else masses.weighed(segments)
        if searches:
            left = _Left(car, table.with_free(**limits), padded(now, energy, size))
            for search in searches:
                car = search.best(car, left)
        car, found = fit(car, now)
        masses = masses and masses.again(car, segments, energy, size)
    if masses is None:
        return Closed(car, found, np.zeros(len(m.use)), np.nan if loose else 0.0, size)
    payload = np.zeros(len(m.use))
    payload[train] = masses.off[masses.of_row]
    return Closed(*fit(car, masses.weighed(segments)), payload, masses.sd, size)


def listed(m: Member, effects: Mapping[str, Mapping[str, float]]) -> tuple[Vehicle, ParameterTable]:
    """The vehicle with these effects at what is given of them, and the table with their sizes free."""
    car, table = m.vehicle, m.table
    if "power_w" in opened(effects, "auxiliary_power"):  # the same column as the declared load
        table = table.with_free(**{"battery.auxiliary_w": False})
    for id, given in effects.items():
        e = _as_given(id, given, m)
        car = car.plus(e)
        sizes = [p.name for p in e.parameters if isinstance(p, Size) and p.name not in given]
        by = tuple(p.by for p in e.parameters if p.by)
        groups = tuple(str(g) for g in range(1, most_group(m.segments, by) + 1))
        table = table.plus(*effect_coefficients(e, sizes, shapes=False, groups=groups))
    return car, table


def opened(effects: Mapping[str, Mapping[str, float]], id: str) -> set[str]:
    """Parameters of a listed effect that are not given."""
    return {p.name for p in LIBRARY[id].parameters} - {*effects[id]} if id in effects else set()


def _as_given(id: str, given: Mapping[str, float], m: Member) -> Effect:
    """An effect at what is given of its parameters, the others at their null values."""
    kind = LIBRARY[id]
    e = at_null(kind, gears=most_group(m.segments, tuple(p.by for p in kind.parameters if p.by)))
    for name, value in given.items():
        e = eqx.tree_at(lambda e, name=name: getattr(e, name), e, np.asarray(float(value)))
    return e


class _Trips(NamedTuple):
    """What each trip's mass is off by about the vehicle's mean, as a share, and its standard deviation over trips."""

    of_row: np.ndarray
    off: np.ndarray
    sd: float
    groups: int  # trips, and more that have no row

    @classmethod
    def of(cls, segments: Segments, least: int) -> "_Trips | None":
        """Before anything is known of them; None where trips are too few to have a variance."""
        names, of_row = np.unique(np.asarray(segments.trip), return_inverse=True)
        n = len(names)
        return cls(of_row, np.zeros(n), MASS_SD, _whole(n, least)) if n >= _LEAST_TRIPS else None

    def weighed(self, segments: Segments) -> Segments:
        """The rows with these masses."""
        return weighed(segments, self.off[self.of_row])

    def again(self, car: Vehicle, segments: Segments, energy: np.ndarray, size: int) -> "_Trips":
        """One step of EM: each trip's mass with all else as it is, then the variance that they have. `size`: as in
        `padded`."""
        mean = float(car.effect("mass_scale").scale)
        sd = self.sd * (1.0 + mean)
        own = ParameterTable((coefficient("effects.mass_scale.scale", "1", mean, sd, positive=False),))
        rows, n = padded(segments, energy, size), len(self.off)
        found = linear_fit(car, own, lambda: [Rows(rows, self.of_row, self.of_row)], "energy_wh", groups=self.groups)
        off, sd = (found.values[:n, 0] - mean) / (1.0 + mean), found.sd[:n, 0] / (1.0 + mean)
        return self._replace(off=off, sd=float(np.sqrt(np.mean(off**2 + sd**2))))


class _Left:
    """What a threshold leaves of the squares once all other coefficients have moved along as the rows would have
    them."""

    def __init__(self, car: Vehicle, table: ParameterTable, rows: Fit):
        self.rows, self.names = rows, [c.path for c in table.free]
        self.columns = np.asarray(rows.weight)[:, None] * jacobian(car, table, rows.segments, "energy_wh")
        self.free = max(float(np.sum(rows.weight)) - len(self.names), 1.0)  # rows less what is fitted to them

    def without(self, path: str) -> Callable[[Vehicle], float]:
        """The sum of squares of a vehicle, the coefficient at `path` being held where the vehicle has it."""
        own = self.columns[:, [n != path for n in self.names]]
        size = np.linalg.norm(own, axis=0)
        base, _ = np.linalg.qr(own[:, size > 0] / size[size > 0])

        def left(car: Vehicle) -> float:
            off = np.asarray(self.rows.weight * (self.rows.measured - predict(car, self.rows.segments, "energy_wh")))
            return float(np.sum((off - base @ (base.T @ off)) ** 2))

        return left


class _Search:
    """A threshold's values that are tried next: first its grid, then finer steps about the best of the last."""

    def __init__(self, id: str, p: Parameter, row_s: float):
        self.id, self.p = id, p
        self.span = [x * (row_s if p.in_rows else 1.0) for x in p.grid]

    def best(self, car: Vehicle, squares: _Left) -> Vehicle:
        """The vehicle with the value that leaves the least squares; with the null value if none takes off enough."""
        null, of = float(self.p.null), squares.without(f"effects.{self.id}.{self.p.name}")
        left = {x: of(self._at(car, x)) for x in (null, *self.span)}
        value = min(left, key=lambda x: left[x])
        noise = left[value] / squares.free
        if value != null or self.p.smooth:
            self._finer(value, left)
        return self._at(car, value if left[null] - left[value] > _LEAST_GAIN * noise else null)

    def _finer(self, value: float, left: Mapping[float, float]) -> None:
        """Steps of a quarter about a value; as wide as before where it was the last that was tried on its side."""
        # where nothing changes smoothly at the null value, it is no neighbour of the others
        order = sorted(x for x in left if self.p.smooth or x != self.p.null)
        at, gaps = order.index(value), np.diff(order)
        step = float(np.max(gaps[max(at - 1, 0) : at + 1], initial=0.0))
        reach = step if 0 < at < len(order) - 1 else 4.0 * step
        self.span = list(np.clip(value + reach * np.linspace(-1, 1, 9), self.p.lower, self.p.upper))

    def _at(self, car: Vehicle, value: float) -> Vehicle:
        return eqx.tree_at(lambda c: getattr(c.effect(self.id), self.p.name), car, np.asarray(float(value)))


@cache
def closed(data: Data, effects: str) -> tuple[Closed | None, ...]:
    """`kernel` of each vehicle, None of one without training rows. **Arguments:** `effects`, by id with what is given
    of their parameters, as JSON, so that the answer can be kept. Raises `InputError` where no vehicle has any."""
    data.trains()
    given: dict[str, dict[str, float]] = json.loads(effects)
    trained = [m for m in data.vehicles if np.any(m.use == 0)]
    rows = max(len(m.where(0)) for m in trained)
    trips = max(len(np.unique(m.routes[m.where(0)])) for m in trained)
    return tuple(kernel(m, given, rows=rows, trips=trips) if np.any(m.use == 0) else None for m in data.vehicles)
