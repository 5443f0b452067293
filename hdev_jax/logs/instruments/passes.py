"""Altitudes of several passes of one place put together: levelled, compared, averaged.

    reading = h(place) + level of its trip + w + ε

Passes of a place have the road's height h in common, and errors of their own. So what passes differ by has no road in
it and tells the errors: ε, white, of standard deviation σ, and w, that drifts over time (Matérn-3/2, sd s, time τ).
Levels and drifts are the least squares of readings less the mean of all passes of their place, with the prior of w
(levelling: Koch, Parameter Estimation and Hypothesis Testing in Linear Models, 1999, section 3.2). The mean of K
readings so levelled has the noise σ/√K and the drift s/√K, and is smoothed along each pass as its own readings are.

The slopes that single passes give are not averaged instead: half of their variance is what smoothing takes from the
road, the same in all passes. With white noise, the variance of the smoothed slope goes with σ (a slope of Matérn-3/2
has the spectrum 1/ω⁴, the noise of its height as slope σ²ω², so σ²·∫ω²/(1 + (ω/ω₀)⁶), ω₀⁻³ ~ σ): K passes have 1/√K
of it.

What all passes of a place are off by, as by a map's altitude or by one trip that is in the log twice, is in no
difference of passes, and would count as road. So where one pass alone shows much larger errors than passes differ by,
there is nothing to average.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, lsmr

from hdev_jax.logs.instruments.places import Places
from hdev_jax.logs.instruments.smoother import HEIGHT, Course

__all__ = ["Cells", "Pooled", "pooled"]

LAGS = (1, 2, 3, 5, 8, 13, 21, 34, 55)  # visits apart at which errors are compared: 20 m to 1 km of driving
TIMES_S = np.geomspace(5.0, 2000.0, 40)  # that a drift may take: from one cell to half an hour
ALIKE = 3.0  # standard deviations: beyond, passes of a place do not agree, and a drift is more than chance
MOSTLY = 0.5  # share of the error's variance by one pass that passes have to differ by; estimates are off by less
FEW = 50  # visits that an error is estimated from: its variance is known to 20 %
UNKNOWN_M = 1e3  # standard deviation of a trip's level
NEAR, STEPS = 1e-4, 200  # of the least squares: changes from cell to cell are then right to a centimetre


@dataclass(frozen=True)
class Cells:
    """Cells of a log: part of the road without a jump, how far along and when, mean reading and of how many, and the
    slope by its own pass alone."""

    part: Int[np.ndarray, " cell"]
    at_m: Float[np.ndarray, " cell"]
    clock_s: Float[np.ndarray, " cell"]
    height: Float[np.ndarray, " cell"]
    count: Float[np.ndarray, " cell"]
    slope: Float[np.ndarray, " cell"]


@dataclass(frozen=True)
class Pooled:
    """Readings of all passes by cell, how many readings of one pass each is worth, and of how many passes of like
    weight; the visits of its place; the errors that passes show, as a course; how many visits disagree."""

    height: Float[np.ndarray, " cell"]
    count: Float[np.ndarray, " cell"]
    passes: Float[np.ndarray, " cell"]
    visits: Float[np.ndarray, " cell"]
    errors: Course
    disagree: int


@dataclass(frozen=True)
class _Visits:
    """Runs of cells at one place: part, time, place, readings there and of how many, by the pass's smoothed ones too;
    the variance [m²] that positions add."""

    part: np.ndarray
    clock_s: np.ndarray
    place: np.ndarray
    height: np.ndarray
    count: np.ndarray
    smooth: np.ndarray
    wrong: float


def pooled(
    cells: Cells, smooth: Float[np.ndarray, " cell"], places: Places, course: Course, *, least: float
) -> Pooled | None:
    """The readings of a place by all its passes. `smooth` are readings smoothed along each pass, `course` is what
    single passes tell, `least` the noise of steps.

    **Returns:** None where the passes are too few to tell their errors, have most of them in common, or tell no cell
    more than its own pass does.
    """
    at = np.flatnonzero((places.place >= 0) & (cells.count > 0))
    if len(at) == 0:
        return None
    n, place, way = cells.count[at], places.place[at], places.way[at]
    slope = np.bincount(place, n * way * cells.slope[at]) / np.maximum(np.bincount(place, n), 1e-300)
    carried = slope[place] * way * places.ahead_m[at]
    begins = np.r_[True, (np.diff(place) != 0) | (np.diff(cells.part[at]) != 0)]
    edge, visit = np.flatnonzero(begins), np.cumsum(begins) - 1

    def mean(x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x * n, edge) / np.add.reduceat(n, edge)

    # a position that is wrong along the road is an error of the height there
    wrong = places.sd_m**2 * float(np.mean(cells.slope**2))
    v = _Visits(
        cells.part[at][edge], mean(cells.clock_s[at]), place[edge], mean(cells.height[at] + carried),
        np.add.reduceat(n, edge), mean(smooth[at] + carried), wrong,
    )  # fmt: skip
    level = _levels(v, replace(course, drift=0.0))
    errors = _errors(v, level, course, least)
    if errors is None or errors.white**2 + errors.drift**2 < MOSTLY * _no_road(course, cells):
        return None
    level = _levels(v, errors)
    floor, disagree = _floors(v, level)
    if disagree:
        v = replace(v, place=floor)
        level = _levels(v, errors)
    noise = _white(v, errors)
    total, height = _mean(v, w := 1.0 / (errors.drift**2 + noise), v.height - level)
    white = np.bincount(v.place, w**2 * noise) / total**2
    weight, number = np.bincount(v.place, w**2) / total**2, np.bincount(v.place)
    # its own position is another error of what is said to a pass; it keeps its own readings where they are better
    said = (white + errors.drift**2 * weight)[v.place] + v.wrong
    better = (said < noise - v.wrong + errors.drift**2) & (number[v.place] > 1)
    if not better.any():
        return None
    # what all passes say is said once in a visit, in the cell next to the place
    once = np.zeros(len(at), bool)
    once[np.lexsort((np.abs(places.ahead_m[at]), visit))[edge]] = True
    p, joint = v.place[visit], better[visit]
    z, count = cells.height - _spread(cells, v, level), cells.count.copy()
    z[at] = np.where(joint, height[p] - carried, z[at])
    count[at] = np.where(joint, np.where(once, errors.white**2 / (white[p] + v.wrong), 0.0), n)
    passes, visits = np.ones(len(z)), np.ones(len(z))
    passes[at], visits[at] = np.where(joint, 1.0 / weight[p], 1.0), np.where(joint, number[p], 1.0)
    return Pooled(z, count, passes, visits, errors, disagree)


def _no_road(alone: Course, cells: Cells) -> float:
    """Variance of the errors that one pass shows; a drift that is no faster than roads bend may be road."""
    speed = float(np.ptp(cells.at_m)) / max(float(np.ptp(cells.clock_s)), 1e-9)
    fast = alone.drift_s * speed < HEIGHT.shortest
    return alone.white**2 + fast * alone.drift**2


def _white(v: _Visits, course: Course) -> np.ndarray:
    """Variance of each visit's reading without the drift."""
    return course.white**2 / v.count + v.wrong


def _mean(v: _Visits, weight: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weight and mean by place; 1 and 0 where none is."""
    total = np.bincount(v.place, weight)
    total = np.where(total > 0, total, 1.0)
    return total, np.bincount(v.place, weight * x) / total


def _levels(v: _Visits, course: Course) -> Float[np.ndarray, " visit"]:
    """The level of each visit's part, and where the readings drift, what they are off by at that time."""
    w = 1.0 / _white(v, course)
    basis, prior = _basis(v, course)
    size = np.sqrt(np.asarray((basis.multiply(basis)).T @ w + (prior.multiply(prior)).sum(axis=0)).ravel())
    scale = np.where(size > 0, 1.0 / size, 1.0)
    root, n = np.sqrt(w), len(w)
    total, height = _mean(v, w, v.height)

    def forward(x: np.ndarray) -> np.ndarray:
        b = basis @ (scale * x)
        return np.r_[root * (b - _mean(v, w, b)[1][v.place]), prior @ (scale * x)]

    def back(y: np.ndarray) -> np.ndarray:  # less the mean of a place is its own transpose, weighted
        e = root * y[:n]
        e = e - w * (np.bincount(v.place, e) / total)[v.place]
        return scale * (basis.T @ e + prior.T @ y[n:])

    shape = (n + prior.shape[0], basis.shape[1])
    operator: Any = LinearOperator(shape, matvec=forward, rmatvec=back, dtype=float)  # pyright: ignore[reportCallIssue]
    missing = np.r_[root * (v.height - height[v.place]), np.zeros(prior.shape[0])]
    return basis @ (scale * lsmr(operator, missing, atol=NEAR, btol=NEAR, maxiter=STEPS)[0])


def _basis(v: _Visits, course: Course) -> tuple[Any, Any]:
    """Columns `[visit, unknown]` of levels of parts and of values of the drift every τ/2, linear in between; and rows
    of their prior."""
    n, parts = len(v.part), int(v.part.max()) + 1
    level = sparse.csr_array((np.ones(n), (np.arange(n), v.part)), shape=(n, parts))
    ground = sparse.diags_array(np.full(parts, 1.0 / UNKNOWN_M))
    if course.drift == 0:
        return level, ground.tocsr()
    start = np.r_[True, np.diff(v.part) != 0]
    which = np.cumsum(start) - 1
    since = (v.clock_s - v.clock_s[start][which]) / (0.5 * course.drift_s)
    knot = np.floor(since).astype(int)
    last = np.maximum.reduceat(knot, np.flatnonzero(start)) + 2  # knots of each part
    first = np.cumsum(last) - last
    share, rows, at = since - knot, np.arange(n), first[which] + knot
    drift = sparse.csr_array(
        (np.r_[1.0 - share, share], (np.r_[rows, rows], np.r_[at, at + 1])), shape=(n, int(last.sum()))
    )
    like = 1.5 * np.exp(-0.5)  # Matérn-3/2 over half its time, between knots a course of first order
    begins = np.zeros(int(last.sum()), bool)
    begins[first] = True
    scale = np.where(begins, 1.0, 1.0 / np.sqrt(1.0 - like**2)) / course.drift
    before = sparse.diags_array(np.where(begins, 0.0, -like)[1:], offsets=-1)
    walk = sparse.diags_array(scale) @ (sparse.eye_array(len(scale)) + before)
    return sparse.hstack([level, drift]).tocsr(), sparse.block_diag([ground, walk]).tocsr()


def _spread(cells: Cells, v: _Visits, level: np.ndarray) -> Float[np.ndarray, " cell"]:
    """The level by cell: between visits of a part linear in time, beyond them the nearest; 0 in parts without."""
    apart = float(np.ptp(cells.clock_s)) + 1.0
    out = np.interp(cells.clock_s + apart * cells.part, v.clock_s + apart * v.part, level)
    return np.where(np.isin(cells.part, v.part), out, 0.0)


def _errors(v: _Visits, level: np.ndarray, course: Course, least: float) -> Course | None:
    """The course with the errors that passes show: the covariance over time of what each is off its place's mean by.

    Of an error less a mean in which its own share is a, the variance is 1 − a of the error's.
    """
    total, mean = _mean(v, v.count, v.height - level)
    left = 1.0 - v.count / total[v.place]
    passed = left > 1.0 / 3.0
    if passed.sum() < FEW:
        return None
    off = np.where(passed, v.height - level - mean[v.place], 0.0) / np.sqrt(np.where(passed, left, 1.0))
    usual = 1.4826 * float(np.median(np.abs(off[passed])))
    off = np.clip(off, -4.0 * usual, 4.0 * usual)  # bridges and outliers; of normal errors, none
    whole = float(np.mean(off[passed] ** 2))
    apart, like, pairs = [], [], []
    for lag in LAGS:
        both = passed[lag:] & passed[:-lag] & (v.part[lag:] == v.part[:-lag])
        if both.sum() >= FEW:
            apart.append(float(np.median((v.clock_s[lag:] - v.clock_s[:-lag])[both])))
            like.append(float(np.mean((off[lag:] * off[:-lag])[both])))
            pairs.append(float(both.sum()))
    square, tau = 0.0, course.drift_s
    if apart:
        d = np.outer(1.0 / TIMES_S, apart)
        shape = (1.0 + d) * np.exp(-d)
        squares = np.clip(shape @ (np.array(pairs) * like) / (shape**2 @ np.array(pairs)), 0.0, whole)
        best = int(np.argmin((squares[:, None] * shape - like) ** 2 @ np.array(pairs)))
        if squares[best] > ALIKE * whole / np.sqrt(passed.sum()):
            square, tau = float(squares[best]), float(TIMES_S[best])
    white = max(whole - square - v.wrong, 0.0) / float(np.mean(1.0 / v.count[passed]))
    return replace(course, white=max(float(np.sqrt(white)), least), drift=float(np.sqrt(square)), drift_s=tau)


def _floors(v: _Visits, level: np.ndarray) -> tuple[np.ndarray, int]:
    """The places with those apart that lie above or below them, as a road over another, and how many visits are there.

    A visit is compared with the place's median, by the readings that were smoothed along its own pass. Of one of K
    visits, the difference to their middle has the share 1 − 1/K of its variance.
    """
    place, moved = v.place.copy(), np.zeros(len(v.place), bool)
    y, places = v.smooth - level, int(v.place.max()) + 1
    for floor in (1, 2):
        order = np.lexsort((y, place))
        edge = np.flatnonzero(np.r_[True, np.diff(place[order]) != 0])
        number = np.diff(np.r_[edge, len(place)])
        middle, left = np.zeros(int(place.max()) + 1), np.ones(int(place.max()) + 1)
        middle[place[order][edge]] = 0.5 * (y[order][edge + (number - 1) // 2] + y[order][edge + number // 2])
        left[place[order][edge]] = np.sqrt(1.0 - 1.0 / np.maximum(number, 2))
        off = np.abs(y - middle[place]) / left[place]
        many = np.bincount(place)[place] > 1
        usual = 1.4826 * float(np.median(off[many])) if many.any() else 0.0
        apart = many & (off > ALIKE * usual)
        moved |= apart
        if floor == 1:
            place = np.where(apart, place + places, place)
        else:  # of neither: alone
            place = np.where(apart, place.max() + np.cumsum(apart), place)
    return place, int(moved.sum())
