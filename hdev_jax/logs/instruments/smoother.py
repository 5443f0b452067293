"""What readings along a road tell of its slope: a Kalman filter and smoother over distance, their noise by maximum
likelihood.

    reading = h + w + ε,  dh/ds = θ        (or θ + ε, where slopes are read)

The slope θ of the road over distance and the error w over time, that drifts as air pressure and satellites do, are
Matérn-3/2 processes: continuous, as roads are, whose slopes change in vertical curves (sd σ_θ, length ℓ; sd s, time τ).
ε is white, of standard deviation σ. Filter and smoother: Durbin and Koopman, Time Series Analysis by State Space
Methods, 2012, sections 4.3 and 4.4; Matérn processes as states: Hartikainen and Särkkä, MLSP 2010.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

__all__ = ["DRIVE", "HEIGHT", "SLOPE", "Course", "Kind", "Lanes", "course_of", "lanes_of", "smoothed", "usual_sd"]

LANE = 256  # cells that are filtered together; a lane more costs less than a longer one
MARGIN = 64  # cells at a lane's ends that are another's: several spans of smoothing
BATCH = 64  # lanes at a time
SOME = 24  # lanes whose likelihood is maximised: 6,000 cells of 20 m tell the scale of the slopes to a few per cent
UNKNOWN_M = 1e3  # standard deviation of a trip's first height about its first reading
FACTOR = 2.0  # that the typical values of a kind may be off by: the sd of a log-normal prior
DRIFTS = 5.0  # log-likelihood that the two numbers of a drift have to gain: ln n of some hundred readings
_LEAST = 1e-12  # of a variance: readings without noise are met


@dataclass(frozen=True)
class Kind:
    """What is read, the level or its slope; its `typical` standard deviation of slope and length, and the least length;
    whether the readings may have noise beyond their step, and drift."""

    of_slope: bool
    typical: tuple[float, float]
    shortest: float
    noisy: bool = True
    drifts: bool = False


# Roads: slopes of 2 %, hills of 150 m or so; what bends within less than 60 m is none, as vertical curves are longer.
HEIGHT = Kind(False, (0.02, 150.0), 60.0, drifts=True)
SLOPE = Kind(True, (0.02, 150.0), 60.0)
# Speeds over time: accelerations of 0.5 m/s² that change within seconds, a pedal within half of one; only in steps.
DRIVE = Kind(False, (0.5, 4.0), 0.5, noisy=False)


@dataclass(frozen=True)
class Course:
    """Numbers of the model: σ_θ [1], ℓ [m], σ and s in the readings' unit, τ [s]."""

    slope: float
    length_m: float
    white: float
    drift: float = 0.0
    drift_s: float = 60.0


class Lanes(NamedTuple):
    """Cells side by side `[lane, cell]`: steps of distance and time from the cell before, readings (means of `count`
    independent ones; 0: none there) above the lane's `origin`, `share` of the drift that is in them: of readings of K
    passes 1/√K. `at` is the cell's index, `mine` whether the lane answers for it."""

    step_m: np.ndarray
    step_s: np.ndarray
    reading: np.ndarray
    count: np.ndarray
    share: np.ndarray
    at: np.ndarray
    mine: np.ndarray
    origin: np.ndarray


def lanes_of(
    trip: np.ndarray, place_m: np.ndarray, time_s: np.ndarray, reading: np.ndarray, count: np.ndarray, *,
    kind: Kind, passes: np.ndarray | None = None,
) -> Lanes:  # fmt: skip
    """Cells of all trips cut into overlapping lanes of one length; heights less each lane's first one. `passes`: how
    many passes each reading is the mean of."""
    at, mine = [], []
    edges = np.flatnonzero(np.r_[True, trip[1:] != trip[:-1]])
    for a, b in zip(edges, np.r_[edges[1:], len(trip)], strict=True):
        core = LANE - 2 * MARGIN
        for k in range(max(1, -(-int(b - a - 2 * MARGIN) // core))):
            first = a + k * core
            rows = first + np.arange(LANE)
            last = first + 2 * MARGIN + core >= b
            own = (rows >= (first + MARGIN if k else a)) & (rows < (b if last else first + MARGIN + core))
            at.append(np.minimum(rows, b - 1))
            mine.append(own)
    index, own = np.stack(at), np.stack(mine)
    again = np.diff(index, axis=1, prepend=index[:, :1] - 1) == 0
    z, n = reading[index], np.where(again, 0.0, count[index])
    first = np.argmax(n > 0, axis=1)
    origin = np.zeros((len(z), 1)) if kind.of_slope else np.take_along_axis(z, first[:, None], axis=1)
    step_m, step_s = (np.diff(x[index], axis=1, prepend=x[index[:, :1]]) for x in (place_m, time_s))
    share = np.ones_like(n) if passes is None else 1.0 / np.sqrt(passes[index])
    return Lanes(step_m, step_s, np.where(n > 0, z - origin, 0.0), n, share, index, own, origin)


def course_of(lanes: Lanes, kind: Kind, *, least: float, errors: Course | None = None) -> Course:
    """The numbers of greatest likelihood; `least` is the white noise that readings in steps have at least; `errors`
    has the numbers of the errors where they are known.

    A drift is there where it pays, and only of heights: of slopes it could not be distinguished from the road.
    """
    some = np.unique(np.linspace(0, len(lanes.at) - 1, min(SOME, len(lanes.at))).astype(int))
    few = Lanes(*(x[some] for x in lanes))
    (cells,) = _batches(few, SOME)
    steps = np.abs(np.diff(few.reading, axis=1))[few.count[:, 1:] > 0]
    scale = max(float(np.median(steps)) if len(steps) else 0.0, least)

    def course(x: np.ndarray) -> Course:
        slope, length, *others = (float(v) for v in np.exp(np.clip(x, -60.0, 20.0)))
        if errors is not None:
            return replace(errors, slope=slope, length_m=max(length, kind.shortest))
        white, *drift = others or (0.0,)
        return Course(slope, max(length, kind.shortest), float(np.hypot(white, least)), *drift)

    def cost(x: np.ndarray) -> float:
        prior = 0.5 * float(np.sum(((x[:2] - np.log(kind.typical)) / np.log(FACTOR)) ** 2))
        value = prior - float(_called(_likelihood, cells, course(x), kind)[0])
        return value if np.isfinite(value) else 1e300

    def lowest(starts: list[np.ndarray]) -> Any:
        first = min(starts, key=cost)
        simplex = np.vstack([first, first + np.eye(len(first))])
        options = {"xatol": 0.1, "fatol": 0.2, "maxfev": 150, "initial_simplex": simplex}
        return minimize(cost, first, method="Nelder-Mead", options=options)

    sd, length = kind.typical
    whites = [[s * scale] for s in (0.03, 0.3, 1.0)] if kind.noisy and errors is None else [[]]
    found = lowest([np.log([sd, part * length, *w]) for part in (0.4, 1.3) for w in whites])
    if kind.drifts and errors is None:
        tried = [np.r_[found.x, np.log([s * scale, tau])] for s in (1.0, 4.0) for tau in (20.0, 120.0)]
        drifting = lowest(tried)
        found = drifting if drifting.fun < found.fun - DRIFTS else found
    return course(found.x)


def smoothed(
    lanes: Lanes, course: Course, kind: Kind, *, level: bool = False
) -> tuple[Float[np.ndarray, " cell"], Float[np.ndarray, " cell"]]:
    """Posterior mean and standard deviation of the slope in every cell, as tan θ is of heights over metres; or of the
    level."""
    mean, var = (np.concatenate(x)[: len(lanes.at)] for x in zip(
        *(_called(_states, batch, course, kind, level) for batch in _batches(lanes, BATCH)), strict=True))  # fmt: skip
    cells = int(lanes.at.max()) + 1
    out, sd = np.empty(cells), np.empty(cells)
    out[lanes.at[lanes.mine]] = (mean + (lanes.origin if level else 0.0))[lanes.mine]
    sd[lanes.at[lanes.mine]] = np.sqrt(np.maximum(var[lanes.mine], 0.0))
    return out, sd


def usual_sd(lanes: Lanes, course: Course, kind: Kind) -> float:
    """The slope's posterior standard deviation where readings come at an even rate: the median over the first lanes."""
    first = Lanes(*(x[:BATCH] for x in lanes))
    (var,) = (_called(_states, batch, course, kind)[1] for batch in _batches(first, BATCH))
    return float(np.sqrt(max(np.median(var[: len(first.at)][first.mine]), 0.0)))


def _batches(lanes: Lanes, size: int) -> list[tuple[np.ndarray, ...]]:
    """Lanes in batches of one size, the last filled with lanes without readings, so that one program serves all."""
    out = []
    for k in range(0, len(lanes.at), size):
        part = [x[k : k + size] for x in lanes[:5]]
        out.append(tuple(np.concatenate([x, np.zeros((size - len(x), LANE))]) for x in part))
    return out


def _called(
    program: Any, cells: tuple[np.ndarray, ...], course: Course, kind: Kind, level: bool = False
) -> list[np.ndarray]:
    """A program of a batch, in double precision whatever the caller computes in."""
    with jax.enable_x64(True):
        numbers = jnp.asarray([course.slope, course.length_m, course.white, course.drift, course.drift_s])
        states = 5 if course.drift > 0.0 else 3  # an error that does not drift needs none
        sees = jnp.asarray([0.0, 1.0, 0.0, 0.0, 0.0] if kind.of_slope else [1.0, 0.0, 0.0, 1.0, 0.0])[:states]
        wants = jnp.asarray([1.0, 0.0, 0.0, 0.0, 0.0] if level else [0.0, 1.0, 0.0, 0.0, 0.0])[:states]
        return [np.asarray(x) for x in program(tuple(map(jnp.asarray, cells)), numbers, sees, wants)]


def _smooth_course(sd: Array, scale: Array, step: Array) -> tuple[Array, Array]:
    """A Matérn-3/2 course and its derivative over steps: transitions, and covariances of what is new."""
    rate = 1.0 / scale
    d = rate * step
    fades = jnp.exp(-d)
    a, b, c, e = fades * (1.0 + d), fades * step, -(rate**2) * fades * step, fades * (1.0 - d)
    value, bend = sd**2, (rate * sd) ** 2
    new = [[value - value * a**2 - bend * b**2, -value * a * c - bend * b * e]]
    new.append([new[0][1], bend - value * c**2 - bend * e**2])
    return _matrices([[a, b], [c, e]]), _matrices(new)


def _matrices(rows: list[list[Array]]) -> Array:
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _moves(course: Array, ds: Array, dt: Array) -> tuple[Array, Array]:
    """Transitions of (h, θ, dθ/ds, w, dw/dt) over steps of `ds` metres and `dt` seconds, and what is new in them."""
    slope, length, _, drift, tau = course
    turn, of_slope = _smooth_course(slope, length, ds)
    drifts, of_drift = _smooth_course(drift, tau, dt)
    rate = 1.0 / length
    d = rate * ds
    fades = jnp.exp(-d)
    climb = jnp.stack([(2.0 - fades * (2.0 + d)) / rate, (1.0 - fades * (1.0 + d)) / rate**2], axis=-1)[..., None, :]
    # responses to what is new at the step's start: g of θ, its integral G of h; ∫G² by its series where d is small
    g, whole = 2.0 * rate**1.5 * slope * fades * ds, 2.0 * slope * rate**-0.5 * (1.0 - fades * (1.0 + d))
    near, far = jnp.where(d < 0.1, d, 0.0), jnp.where(d < 0.1, 1.0, d)
    shrunk = jnp.exp(-far)
    square = jnp.where(
        d < 0.1,
        near**5 * (1 / 20 - near / 18 + 25 * near**2 / 756 - near**3 / 72),
        far - 2.0 * (2.0 - shrunk * (2.0 + far)) + 1.25 - shrunk**2 * (0.5 * (1.0 + far) * (2.0 + far) + 0.25),
    )
    of_height = (4.0 * (slope / rate) ** 2 * square)[..., None, None]
    both = jnp.stack([0.5 * whole**2, whole * g - of_slope[..., 0, 0]], axis=-1)[..., None, :]
    one, none = jnp.ones_like(of_height), jnp.zeros_like(both)
    square2 = jnp.zeros_like(turn)

    def blocks(height: Array, across: Array, down: Array, road: Array, error: Array) -> Array:
        upper = jnp.concatenate([height, across, none], axis=-1)
        middle = jnp.concatenate([down, road, square2], axis=-1)
        lower = jnp.concatenate([jnp.swapaxes(none, -1, -2), square2, error], axis=-1)
        return jnp.concatenate([upper, middle, lower], axis=-2)

    move = blocks(one, climb, jnp.swapaxes(none, -1, -2), turn, drifts)
    return move, blocks(of_height, both, jnp.swapaxes(both, -1, -2), of_slope, of_drift)


def _product(a: Array, b: Array) -> Array:
    """A matrix by a matrix or a vector, written out: a product of small matrices for each lane is ten times slower."""
    columns = a[:, :, None] if b.ndim == a.ndim else a
    parts = [columns[:, j] * b[j][None] for j in range(b.shape[0])]
    return sum(parts[1:], parts[0])


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=0)


def _outer(a: Array, b: Array) -> Array:
    return a[:, None] * b[None]


def _transposed(a: Array) -> Array:
    return jnp.swapaxes(a, 0, 1)


class _Cell(NamedTuple):
    """What the filter knows of a cell of each lane: its prediction, and how far the reading was from it."""

    move: Array
    mean: Array
    cov: Array
    miss: Array
    var: Array
    gain: Array
    there: Array
    sees: Array


def _forward(cells: Any, course: Array, sees: Array, keep: bool) -> Any:
    """Kalman's filter over the cells of lanes `[lane, cell]`: each `_Cell`, or its log-likelihood.

    Numbers are `[lane]`, vectors `[state, lane]`, matrices `[state, state, lane]`.
    """
    ds, dt, z, n, share = (x.T for x in cells)  # cells lead: the scan runs over them
    slope, length, white, drift, tau = course
    states = len(sees)
    move, new = (jnp.moveaxis(x[..., :states, :states], 1, -1) for x in _moves(course, ds, dt))
    there = n > 0
    noise = white**2 / jnp.where(there, n, 1.0) + _LEAST

    def step(carry: Any, cell: Any) -> Any:
        mean, cov = carry
        move, new, z, noise, there, sees = cell
        mean = _product(move, mean)
        cov = _product(_product(move, cov), _transposed(move)) + new
        towards = _product(cov, sees)
        var = _dot(towards, sees) + noise
        gain = jnp.where(there[None], towards / var[None], 0.0)
        miss = jnp.where(there, z - _dot(mean, sees), 0.0)
        after = mean + gain * miss[None], cov - _outer(gain, towards)
        known = _Cell(move, mean, cov, miss, var, gain, there, sees)
        return after, known if keep else jnp.where(there, -0.5 * (miss**2 / var + jnp.log(var)), 0.0)

    lanes = z.shape[-1]
    first = jnp.stack([UNKNOWN_M**2 * sees[0], slope**2, (slope / length) ** 2, drift**2, (drift / tau) ** 2])[:states]
    start = jnp.zeros((states, lanes)), jnp.broadcast_to(jnp.diag(first)[..., None], (states, states, lanes))
    part = jnp.where((jnp.arange(states) == 3)[None, :, None], share[:, None], 1.0)
    seen = sees[None, :, None] * part  # of a mean over passes, part of the drift
    return jax.lax.scan(step, start, (move, new, z, noise, there, seen))[1]


@jax.jit
def _likelihood(cells: Any, course: Array, sees: Array, _: Array) -> tuple[Array]:
    """The log-likelihood of a batch, but for a constant."""
    return (jnp.sum(_forward(cells, course, sees, keep=False)),)


@jax.jit
def _states(cells: Any, course: Array, sees: Array, wants: Array) -> tuple[Array, Array]:
    """Posterior means and variances `[lane, cell]` of the states asked for."""

    def step(carry: Any, cell: _Cell) -> Any:
        r, n = carry  # what later cells say, as it acts on this one
        precision = jnp.where(cell.there, 1.0 / cell.var, 0.0)
        r = r + cell.sees * (cell.miss * precision - _dot(cell.gain, r))[None]
        n = n - _outer(_product(n, cell.gain), cell.sees)
        n = n + _outer(cell.sees, cell.sees * precision[None] - _product(_transposed(n), cell.gain))
        towards = _product(cell.cov, wants[:, None])
        mean = _dot(cell.mean, wants[:, None]) + _dot(towards, r)
        spread = _dot(towards, wants[:, None]) - _dot(towards, _product(n, towards))
        back = _transposed(cell.move)
        return (_product(back, r), _product(_product(back, n), cell.move)), (mean, spread)

    lanes = cells[0].shape[0]
    end = jnp.zeros((len(wants), lanes)), jnp.zeros((len(wants), len(wants), lanes))
    mean, var = jax.lax.scan(step, end, _forward(cells, course, sees, keep=True), reverse=True)[1]
    return mean.T, var.T
