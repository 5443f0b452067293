"""Candidates without a name: monomials of the log's channels, where the library has none for what is left.

Each monomial is a power at the battery (where force or torque is the target, a force at the wheels), k times a product
of channels. It goes through the kernel, the scores, the joint refit and the gates as an effect of the library does;
trying many of them counts. Its coefficient has the unit that makes the product a power (a force). What is accepted is a
description, not a cause: it is labelled as not in the library and is added to no vehicle that is handed out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.physics import Effect, Size, Vehicle
from hdev_jax.physics.effect import Car, Names, Parameters, Point, Real, Row, Stage
from hdev_jax.segments import NO_CAUSE, Segments
from hdev_jax.targets import TARGETS, TargetName
from hdev_jax.units import registry, unit_of

__all__ = [
    "TERM", "Described", "DescribedForce", "Factor", "Term", "described_by", "describing", "formula", "monomials",
    "product", "thresholds",
]  # fmt: skip

MOST_ROWS = 60_000  # above it products of two channels are left out: hundreds of columns
TOGETHER = 64  # monomials that are evaluated at once
QUANTILES = (0.5, 0.75, 0.9)
STEP = 0.1  # of the rows, on either side of a threshold that is looked at again
MOTION = ("speed_mps", "accel_mps2")
TERM = "derived:expression"
# units with an offset count as differences, a slope as a ratio
_PLAIN = {"degree_Celsius": "kelvin", "degree_Fahrenheit": "delta_degree_Fahrenheit", "tan": "1", "%": "percent"}


@dataclass(frozen=True)
class Factor:
    """One factor of a monomial: a channel or a motion less `centre`, to a power, or whether it is above a threshold."""

    name: str
    exponent: int = 1
    centre: float = 0.0
    above: float | None = None

    def __call__(self, segments: Segments) -> np.ndarray:
        """The factor on every row."""
        x = np.asarray(getattr(segments, self.name) if self.name in MOTION else segments.channels[self.name], float)
        return (x > self.above).astype(float) if self.above is not None else (x - self.centre) ** self.exponent

    def words(self) -> str:
        """`(ambient_temp_c − 12.3)²`, `[humidity_pct > 70]`."""
        if self.above is not None:
            return f"[{self.name} > {self.above:.4g}]"
        inner = self.name if not self.centre else f"({self.name} − {self.centre:.4g})"
        return inner + {1: "", 2: "²", 3: "³"}[self.exponent]

    def unit(self) -> str:
        """Its unit as pint reads it; 1 for a threshold and where the column's name says none."""
        if self.above is not None:
            return "1"
        own = {"speed_mps": "m/s", "accel_mps2": "m/s**2"}.get(self.name) or unit_of(self.name) or "1"
        return f"({_PLAIN.get(own, own)})**{self.exponent}"


@dataclass(frozen=True)
class Term:
    """A term without a name as it is in a model: a monomial over its RMS `scale`, in the channel `TERM` of the rows."""

    factors: tuple[Factor, ...]
    scale: float
    values: np.ndarray | None = None  # where it reads what only the training rows have
    id: str = "expression"

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that it reads."""
        return tuple(dict.fromkeys(f.name for f in self.factors))

    def column(self, segments: Segments) -> np.ndarray:
        """Its value on every row: of the rows that it was made on, where it has `values`."""
        return product(self.factors, segments) / self.scale if self.values is None else self.values


class Described(Effect):
    """k times a column that was made for it, as power at the battery."""

    id: ClassVar[str] = "expression"
    stage: ClassVar[Stage] = "battery"
    order: ClassVar[int] = 80
    equation: ClassVar[str] = "k·term"
    source: ClassVar[str] = "found in the log by search"
    needs: ClassVar[Names] = (TERM,)
    parameters: ClassVar[Parameters] = (Size("k", "W", 0.0, 1000.0),)
    k: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return self.k * row.channels[TERM]


class DescribedForce(Effect):
    """k times a column that was made for it, as a force at the wheels: for targets that the battery lies behind."""

    id: ClassVar[str] = Described.id
    stage: ClassVar[Stage] = "road"
    order: ClassVar[int] = 80
    equation: ClassVar[str] = Described.equation
    source: ClassVar[str] = Described.source
    needs: ClassVar[Names] = (TERM,)
    entries: ClassVar[Names] = ("road",)
    parameters: ClassVar[Parameters] = (Size("k", "N", 0.0, 100.0),)
    k: Any

    def force(self, row: Row, car: Car) -> Real:
        return self.k * row.channels[TERM]


def describing(target: TargetName) -> type[Described] | type[DescribedForce]:
    """The effect that a monomial is for this target: a power, or a force where the battery lies behind it."""
    return Described if TARGETS[target].of_battery else DescribedForce


def _coefficient_unit(factors: Sequence[Factor], of: str) -> str:
    """The coefficient's unit: that of the whole (`W`, `N`) over the product of the factors' units."""
    ureg = registry()
    unit = ureg.Quantity(1.0, of)
    for f in factors:
        unit = unit / ureg.Quantity(1.0, f.unit())
    return f"{unit.units:~P}"


def formula(term: Term, value: float, sd: float, target: TargetName) -> str:
    """`(2.5 ± 0.1) W · [humidity_pct > 70]`."""
    unit = _coefficient_unit(term.factors, describing(target).parameters[0].unit)
    words = "·".join(f.words() for f in term.factors)  # as `humidity_pct·speed_mps`
    return f"({value / term.scale:.3g} ± {sd / term.scale:.2g}) {unit} · {words}"


def product(factors: Sequence[Factor], segments: Segments) -> np.ndarray:
    """The monomial on every row, in SI units."""
    return np.prod([f(segments) for f in factors], axis=0)


def monomials(segments: Segments, rows: int) -> list[tuple[Factor, ...]]:
    """Every monomial that the log can tell: powers of motion, each channel, its square, with speed, above quantiles."""
    logged = segments.without(*NO_CAUSE).channels
    values = {k: np.asarray(v, dtype=float)[:rows] for k, v in logged.items() if ":" not in k}
    values = {k: v for k, v in values.items() if np.ptp(v) > 0}
    centred = {k: float(f"{np.median(v):.3g}") for k, v in values.items() if unit_of(k) == "degree_Celsius"}
    speed = Factor("speed_mps")
    sets: list[tuple[Factor, ...]] = [(Factor("speed_mps", 2),), (Factor("speed_mps", 3),), (Factor("accel_mps2"),)]
    linear = {k: Factor(k, centre=centred.get(k, 0.0)) for k in values}
    for k, f in linear.items():
        sets += [(f,), (f, speed)]
        if len(np.unique(values[k][:: max(1, rows // 2000)])) > 2:
            sets.append((replace(f, exponent=2),))
            cuts = sorted({float(f"{np.quantile(values[k], q):.3g}") for q in QUANTILES})
            sets += [(Factor(k, above=c),) for c in cuts if values[k].min() <= c < values[k].max()]
    if rows <= MOST_ROWS:
        sets += [(linear[a], linear[b]) for a, b in combinations(linear, 2)]
    return sets


@dataclass(frozen=True)
class Terms:
    """Monomials as candidates, each over its RMS `scales` on the log: what makes their columns of any rows."""

    sets: tuple[tuple[Factor, ...], ...]
    scales: tuple[float, ...]
    car: Vehicle  # that describes: k is 1
    target: TargetName

    @property
    def candidates(self) -> list[Candidate]:
        """One for each monomial."""
        return [Candidate(describing(self.target), ("k",), (None,), (), "size", (i,)) for i in range(self.width)]

    @property
    def left_out(self) -> dict[str, str]:
        """No effect is left out."""
        return {}

    @property
    def width(self) -> int:
        """How many there are."""
        return len(self.sets)

    def write(self, out: np.ndarray, segments: Segments, at: Sequence[int] | None = None) -> None:
        """Write what 1 W (or 1 N) times each monomial adds to the target, through the whole vehicle, into `out`."""
        wanted = list(range(self.width) if at is None else at)
        segments = jax.tree.map(jnp.asarray, segments)
        for start in range(0, len(wanted), TOGETHER):
            some = wanted[start : start + TOGETHER]
            terms = np.zeros((TOGETHER, len(segments)))  # always as many, so that it is compiled once
            for i, k in enumerate(some):
                terms[i] = product(self.sets[k], segments) / self.scales[k]
            added = np.asarray(_added(self.car, segments, self.target, jnp.asarray(terms)))
            out[:, start : start + len(some)] = added[: len(some)].T


@eqx.filter_jit
def _added(car: Vehicle, segments: Segments, target: TargetName, terms: Array) -> Array:
    """What each term adds to the target, to first order about none: limits that it would move are not moved."""

    def predicted(term: Array) -> Array:
        return car.predict(segments.with_channels(**{TERM: term}), target)

    _, adds = jax.linearize(predicted, jnp.zeros(terms.shape[1]))
    return jax.lax.map(adds, terms)


def thresholds(factors: Sequence[Factor], segments: Segments, rows: int) -> list[tuple[Factor, ...]]:
    """The channels of a monomial above thresholds: at every twentieth of the first `rows` rows, or, of a threshold, at
    every hundredth near it."""
    near = factors[0].above if len(factors) == 1 else None
    out: list[tuple[Factor, ...]] = []
    for name in dict.fromkeys(f.name for f in factors if f.name not in MOTION and ":" not in f.name):
        x = np.asarray(segments.channels[name], dtype=float)[:rows]
        at = np.arange(0.05, 0.96, 0.05)
        if near is not None:
            at = np.clip(np.mean(x <= near) + np.arange(-STEP, STEP + 0.005, 0.01), 0.01, 0.99)
        cuts = {float(f"{q:.4g}") for q in np.quantile(x, at)} - {near}
        out += [(Factor(name, above=c),) for c in sorted(cuts) if x.min() <= c < x.max()]
    return out


def described_by(
    vehicle: Vehicle, segments: Segments, rows: int, target: TargetName, made: Sequence[tuple[Factor, ...]]
) -> Terms:
    """The monomials of `made` that vary on the first `rows` rows."""
    sets, scales = [], []
    for factors in made:
        term = product(factors, segments)[:rows]
        scale = float(np.sqrt(np.mean(term**2)))
        if np.isfinite(scale) and np.std(term) > 1e-9 * scale > 0:
            sets, scales = [*sets, factors], [*scales, scale]
    return Terms(tuple(sets), tuple(scales), vehicle.plus(describing(target)(np.asarray(1.0))), target)
