"""A formula for what is left where the library has none: sparse search over monomials of the log's channels.

Each monomial is a power at the battery (where force or torque is the target, a force at the wheels), k times a product
of channels, and goes through the kernel, the scores, the joint refit and the placebos as an effect of the library does;
trying many of them counts. Its coefficient has the unit that makes the product a power (a force). What is accepted is a
description, not a cause: it is labelled as not in the library and is added to no vehicle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.select import choose
from hdev_jax.diagnosis.scores.look import Loop, Search, View, look
from hdev_jax.inference.sheet import BATTERY_TARGETS
from hdev_jax.physics import Effect, Parameter, Vehicle
from hdev_jax.physics.vehicle import Target
from hdev_jax.segments import Segments
from hdev_jax.units import registry, unit_of

__all__ = [
    "TERM", "Described", "DescribedForce", "Expression", "Factor", "described_by", "describing", "find_expression",
    "monomials", "product", "thresholds", "words_of",
]  # fmt: skip

STRICTER = 5.0  # a description of the rest has to clear a level so much lower than a cause does
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


class Described(Effect):
    """k times a column that was made for it, as power at the battery."""

    id: ClassVar = "expression"
    stage: ClassVar = "battery"
    order: ClassVar = 80
    equation: ClassVar = "k·term"
    source: ClassVar = "found in the log by search"
    needs: ClassVar = (TERM,)
    parameters: ClassVar = (Parameter("k", "W", 0.0, 1000.0),)
    k: Any

    def power(self, row, car, point):
        return self.k * row.channels[TERM]


class DescribedForce(Effect):
    """k times a column that was made for it, as a force at the wheels: for targets that the battery lies behind."""

    id: ClassVar = Described.id
    stage: ClassVar = "road"
    order: ClassVar = 80
    equation: ClassVar = Described.equation
    source: ClassVar = Described.source
    needs: ClassVar = (TERM,)
    entries: ClassVar = ("road",)
    parameters: ClassVar = (Parameter("k", "N", 0.0, 100.0),)
    k: Any

    def force(self, row, car):
        return self.k * row.channels[TERM]


def describing(target: Target) -> type[Described] | type[DescribedForce]:
    """The effect that a monomial is for this target: a power, or a force where the battery lies behind it."""
    return Described if target in BATTERY_TARGETS else DescribedForce


@dataclass(frozen=True)
class Expression:
    """What was accepted: the formula with its coefficient, the channels in it, in how many ways it was sought, the
    prediction with it in place, and the loop and the state that have it."""

    formula: str
    factors: tuple[Factor, ...]
    q_value: float
    ways: float
    predicted: np.ndarray
    loop: Loop
    state: Search


def _coefficient_unit(factors: Sequence[Factor], of: str) -> str:
    """The coefficient's unit: that of the whole (`W`, `N`) over the product of the factors' units."""
    ureg = registry()
    unit = ureg.Quantity(1.0, of)
    for f in factors:
        unit = unit / ureg.Quantity(1.0, f.unit())
    return f"{unit.units:~P}"


def product(factors: Sequence[Factor], segments: Segments) -> np.ndarray:
    """The monomial on every row, in SI units."""
    out = np.ones(len(segments))
    for f in factors:
        out = out * f(segments)
    return out


def words_of(factors: Sequence[Factor]) -> str:
    """A monomial as it is written: `humidity_pct·speed_mps`."""
    return "·".join(f.words() for f in factors)


def monomials(segments: Segments, rows: int) -> list[tuple[Factor, ...]]:
    """Every monomial that the log can tell: powers of motion, each channel, its square, with speed, above quantiles."""
    values = {k: np.asarray(v, dtype=float)[:rows] for k, v in segments.channels.items() if ":" not in k}
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
    target: Target

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
def _added(car: Vehicle, segments: Segments, target: Target, terms: Array) -> Array:
    def predicted(term: Array) -> Array:
        return car.predict(segments.with_channels(**{TERM: term}), target)

    nothing = predicted(jnp.zeros(terms.shape[1]))
    return jax.lax.map(lambda term: predicted(term) - nothing, terms)


def thresholds(factors: Sequence[Factor], segments: Segments, rows: int) -> list[tuple[Factor, ...]]:
    """The channels of a monomial above thresholds: at every twentieth of the first `rows` rows, or, of a threshold, at
    every hundredth near it."""
    near = factors[0].above if len(factors) == 1 else None
    out: list[tuple[Factor, ...]] = []
    for name in dict.fromkeys(f.name for f in factors if f.name not in MOTION):
        x = np.asarray(segments.channels[name], dtype=float)[:rows]
        at = np.arange(0.05, 0.96, 0.05)
        if near is not None:
            at = np.clip(np.mean(x <= near) + np.arange(-STEP, STEP + 0.005, 0.01), 0.01, 0.99)
        cuts = {float(f"{q:.4g}") for q in np.quantile(x, at)} - {near}
        out += [(Factor(name, above=c),) for c in sorted(cuts) if x.min() <= c < x.max()]
    return out


def described_by(
    vehicle: Vehicle, segments: Segments, rows: int, target: Target, made: Sequence[tuple[Factor, ...]]
) -> Terms:
    """The monomials of `made` that vary on the first `rows` rows."""
    sets, scales = [], []
    for factors in made:
        term = product(factors, segments)[:rows]
        scale = float(np.sqrt(np.mean(term**2)))
        if np.isfinite(scale) and np.std(term) > 1e-9 * scale > 0:
            sets, scales = [*sets, factors], [*scales, scale]
    return Terms(tuple(sets), tuple(scales), vehicle.plus(describing(target)(np.asarray(1.0))), target)


def find_expression(
    state: Search, problem: Loop, everything: Segments, *, predict: Callable[..., np.ndarray],
    first: tuple[Factor, ...] = (), ways: float = 1.0, tell: Callable[[str], None] = lambda _: None,
) -> Expression | None:  # fmt: skip
    """The monomial that clears every bar that an effect has to clear, at a stricter level; None where none does.

    **Arguments:** where the loop ended; its `problem` on training rows (whose effects are not looked at); `everything`,
    the rows to predict with `predict(vehicle, segments)`; `first`, a monomial that is tried before all others, and in
    how many `ways` it was sought on these rows before.
    """
    start = replace(state, refused=(), taken_out=())
    if first:
        best, view = _best(start, problem, [first])
        if best is not None and view is not None:
            view.counted(Described.id, ways)  # the same rows chose it
        if found := _chosen(start, problem, best, view, everything, predict, tell):
            return found
    made = monomials(problem.rows.segments, problem.rows.rows)
    best, view = _best(start, problem, made)
    if best is None or view is None or view.q[Described.id] > problem.fdr:
        return None
    # what rises with a channel may be switched by it, and a threshold that is off leaves some of the cause to whatever
    # is near
    for _ in range(2):
        more = thresholds(best[0], problem.rows.segments, problem.rows.rows)
        made += [t for t in more if t not in made]
        best, view = _best(start, problem, made)
        if best is None or best[0][0].above is None:
            break
    return _chosen(start, problem, best, view, everything, predict, tell)


def _best(start: Search, problem: Loop, made: Sequence[tuple[Factor, ...]]) -> tuple[Any, View | None]:
    """The best monomial of those made with its scale, None where none can be told, and the look at all of them."""
    terms = described_by(start.fit.vehicle, problem.rows.segments, problem.rows.rows, problem.target, made)
    view = look(problem, start, made=terms) if terms.width else None
    if view is None or Described.id not in view.best:
        return None, view
    which = view.best[Described.id].candidate.columns[0]
    return (terms.sets[which], terms.scales[which]), view


def _chosen(
    start: Search, problem: Loop, best: Any, view: View | None, everything: Segments,
    predict: Callable[..., np.ndarray], tell: Callable[[str], None],
) -> Expression | None:  # fmt: skip
    """The best monomial of a look, if it clears every bar."""
    if best is None or view is None:
        return None
    factors, scale = best
    segments = problem.rows.segments
    rows = replace(problem.rows, segments=segments.with_channels(**{TERM: product(factors, segments) / scale}))
    narrow = replace(problem, rows=rows, fdr=problem.fdr / STRICTER)
    chosen = choose(narrow, start, view, tell, skip=(), tries=1, forms=False)
    if chosen is None:
        return None
    at = next(i for i, c in enumerate(chosen.fit.table.free) if c.path == "effects.expression.k")
    value, sd = chosen.fit.values[at] / scale, chosen.fit.sd[at] / scale
    unit = _coefficient_unit(factors, describing(problem.target).parameters[0].unit)
    formula = f"({value:.3g} ± {sd:.2g}) {unit} · {words_of(factors)}"
    everything = everything.with_channels(**{TERM: product(factors, everything) / scale})
    predicted = predict(chosen.fit.vehicle, everything)
    ways = view.ways[Described.id]
    return Expression(formula, factors, chosen.found[-1].q_value, ways, predicted, narrow, chosen)
