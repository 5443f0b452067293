"""Whether what is left follows a channel of the log, asked of rows: where trips are too few to bear a formula out.

A formula has to hold over clusters, and a dozen trips cannot say so at the level that a search over a hundred monomials
asks for, however plainly each trip shows it. That something is left they can say: no noise follows a channel, or the
motion, so closely once stretches of it have a sign drawn at random. A hint is no cause and has no interval; it says
what is left and which effects only stood in for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.expression import (
    MOST_ROWS,
    TOGETHER,
    Factor,
    Terms,
    described_by,
    monomials,
    product,
    thresholds,
    words_of,
)
from hdev_jax.diagnosis.noise.model import without_level
from hdev_jax.diagnosis.scores.evidence import ABSORBED
from hdev_jax.diagnosis.scores.look import Loop, Search
from hdev_jax.segments import trip_slices

__all__ = ["Hint", "find_hint"]

DRAWS, AT_ONCE = 999, 27  # of signs: the largest of so many is a thousandth, the level of what is left
STRETCH = 12  # rows that have one sign: what whitening leaves of the noise's colour is shorter
ALONE = 0.05  # p that the other trips have to reach without the one that speaks loudest


@dataclass(frozen=True)
class Hint:
    """The monomial that whitened rows follow best, and its value on the loop's padded rows."""

    factors: tuple[Factor, ...]
    column: Float[np.ndarray, " padded"]

    def words(self) -> str:
        """`[humidity_pct > 70]`."""
        return words_of(self.factors)


def find_hint(state: Search, problem: Loop) -> Hint | None:
    """What the rows of the log follow: the largest gain over all monomials, if it is larger than with any of `DRAWS`
    sets of signs (max-T, Westfall and Young 1993).

    A sign for each stretch of rows keeps what the size of the noise has to do with the rows. Trips' levels are taken
    out first. None where no monomial stands out in two trips at least; nor is it asked of more than `MOST_ROWS` rows.
    """
    rows, segments = problem.rows.rows, problem.rows.segments
    if rows > MOST_ROWS:
        return None
    seed, made = int(problem.rng.integers(2**62)), monomials(segments, rows)
    best, chance = None, np.zeros(DRAWS)
    for start in range(0, len(made), TOGETHER):
        units = _units(state, problem, made[start : start + TOGETHER])
        if units.sets:
            best = max((best, units.best()), key=lambda b: b.gain) if best else units.best()
            chance = np.maximum(chance, units.by_chance(np.random.default_rng(seed)))
    if best is None or best.gain <= np.max(chance):
        return None
    least = float(np.quantile(chance, 1 - ALONE))
    found = None
    for _ in range(3):  # that something follows it is known: then what describes it best, of thresholds too
        if best.of_others <= least:
            break
        found = best
        best = _units(state, problem, [best.factors, *thresholds(best.factors, segments, rows)]).best()
        if best.factors == found.factors:
            break
    return Hint(found.factors, product(found.factors, segments)) if found else None


@dataclass(frozen=True)
class _Best:
    """The monomial of most gain in log-likelihood, and its gain without the trip that adds most to it."""

    factors: tuple[Factor, ...]
    gain: float
    of_others: float


@dataclass(frozen=True)
class _Units:
    """Monomials of which something is left beside the vehicle, their whitened columns of length 1, and the residual."""

    sets: list[tuple[Factor, ...]]
    columns: Float[np.ndarray, "row k"]
    left: Float[np.ndarray, " row"]
    slices: list[slice]

    def best(self) -> _Best:
        """The first of the largest gain."""
        gains = 0.5 * (self.left @ self.columns) ** 2
        k = int(np.argmax(gains))
        return _Best(self.sets[k], float(gains[k]), of_others(self.columns[:, k], self.left, self.slices))

    def by_chance(self, rng: np.random.Generator) -> Float[np.ndarray, " draw"]:
        """The largest gain with each set of signs."""
        n, out = len(self.left), []
        for _ in range(DRAWS // AT_ONCE):
            place = (np.arange(n) + rng.integers(STRETCH, size=(AT_ONCE, 1))) // STRETCH
            sign = rng.choice([-1.0, 1.0], size=(AT_ONCE, n // STRETCH + 2))
            out.append(0.5 * np.max(((np.take_along_axis(sign, place, 1) * self.left) @ self.columns) ** 2, axis=1))
        return np.concatenate(out)


def _units(state: Search, problem: Loop, made: Sequence[tuple[Factor, ...]]) -> _Units:
    slices = [s for _, s in trip_slices(problem.trip)]
    terms = described_by(state.fit.vehicle, problem.rows.segments, problem.rows.rows, problem.target, made)
    if not terms.width:
        return _Units([], np.zeros((problem.rows.rows, 0)), np.zeros(problem.rows.rows), slices)
    columns, left = _whitened(state, problem, terms)
    lengths = np.sqrt(np.sum(columns**2, axis=0))
    there = np.flatnonzero(lengths > 0)
    return _Units([terms.sets[int(k)] for k in there], columns[:, there] / lengths[there], left, slices)


def _whitened(state: Search, problem: Loop, terms: Terms) -> tuple[np.ndarray, np.ndarray]:
    """The monomials' columns and the residual as white noise meets them, without the trips' levels and the fitted
    coefficients' columns; columns of which next to nothing is left are 0."""
    ground = problem.ground(state.fit, problem.noise(state.fit))
    parts, before = [], np.zeros(len(state.table.free) + terms.width + 1)
    for chunk in ground.chunks():
        white = ground.white(chunk, ground.rows(chunk, terms.width, lambda out, c: terms.write(out, c.segments)))
        before += np.sum(white[:, :-1] ** 2, axis=0)
        parts.append(without_level(white[:, :-1], white[:, -1], chunk.slices()))
    out, base = np.concatenate(parts), len(state.table.free)
    out[:, np.sum(out**2, axis=0) <= ABSORBED * before] = 0.0  # what only trips tell
    scaled = out[:, :base] / np.sqrt(np.maximum(before[:base], 1e-300))
    rest = out[:, base:] - scaled @ np.linalg.lstsq(scaled, out[:, base:], rcond=1e-10)[0]
    rest[:, :-1][:, np.sum(rest[:, :-1] ** 2, axis=0) <= ABSORBED * before[base:-1]] = 0.0
    return rest[:, :-1], rest[:, -1]


def of_others(column: np.ndarray, left: np.ndarray, slices: Sequence[slice]) -> float:
    """Gain of one column without the trip that adds most to it."""
    cross = np.array([float(column[s] @ left[s]) for s in slices])
    square = np.array([float(column[s] @ column[s]) for s in slices])
    others = np.arange(len(slices)) != int(np.argmax(cross * np.sign(cross.sum())))
    return 0.5 * float(cross[others].sum()) ** 2 / max(float(square[others].sum()), 1e-300)
