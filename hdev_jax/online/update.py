"""One row more: a pure function of state and row, for one call a row, for `jax.lax.scan` over a log, for `jax.vmap`
over vehicles.

With z = [x | r] of a row, x the kernel's Jacobian and r measured − predicted from the tabular values, the errors
e = r − xδ are e_i = ρ·e_{i−1} + ε_i. Whitened rows (z_i − ρ^n·z_{i−n})/√q, n rows after the last one used and q the
variance of what came in between over that of ε, are added to the sums of each model of the noise; its posterior is
(Λ₀ + G/σ²)⁻¹. Models are weighed by the likelihood of what they predicted (West and Harrison, Bayesian Forecasting and
Dynamic Models, 1997, section 12.2: multi-process models).

What neighbouring rows have in common is a level l that wanders about 0 (Ornstein-Uhlenbeck: sd s, for a time τ): of two
rows dt apart the earlier level is φ·l + N(0, s²(1 − φ²)), φ = exp(−dt/τ), given the later one.

**What is approximate:** x is taken once, at the estimate before the row (extended Kalman filter); rows that have been
used are not linearised again. Only efficiencies and their switch between driving and braking are not linear: for them
the second-order term is neglected.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from scipy import stats

from hdev_jax.inference.calibrate import STUDENT_DF, UNBOUNDED
from hdev_jax.inference.parameters import insert
from hdev_jax.logs.limits import (
    CHARGES_W,
    GAP_SAMPLES,
    MAX_GRADE_RAD,
    MAX_POWER_W,
    MAX_SPEED_MPS,
    REVERSE_MPS,
    STANDS_MPS,
)
from hdev_jax.online.form import COUNTS, NEEDED, Form
from hdev_jax.online.state import Now, State
from hdev_jax.online.sums import SHARE, TINY, aged, faded, on_a_new_trip, whole_posterior
from hdev_jax.online.watch import WATCH_ROWS, watched
from hdev_jax.segments import Segments
from hdev_jax.targets import TARGETS
from hdev_jax.units import J_PER_WH

__all__ = ["expected", "one_row", "scan", "update", "wh_per_unit"]

LONGEST_S = 86_400.0  # a row of more than a day is none
ENOUGH = 20.0  # rows that show the noise, from which on models of it are weighed by what they predict
FAULT = 6.0  # scales: beyond, a row is an instrument's fault; it is no neighbour of the next (`inference.predictive`)
ALIKE = 20.0  # rows that are believed to be equally noisy, before any are seen
QUIET = 0.05  # least variance of a row over that of all: rows at rest are not exact
LARGE = 100.0  # mean squares of the target: above, a prediction says nothing more of its noise
EDGE = 1e-6  # of a bounded support, that estimates are kept off its ends
MOST = 1e9  # no channel has more in SI units; the squares of such numbers still add up
RANGES = {"mass_kg": (1.0, 1e6), "grade_rad": (-MAX_GRADE_RAD, MAX_GRADE_RAD)}  # the heaviest trucks have 8e5 kg
NORMAL_SCORE = 0.774  # mean square of a weighed normal error over the scale that a Student t of 4 degrees gives it


def one_row(form: Form, row: Float[Array, " column"]) -> Segments:
    """A row's vector as `Segments` of one row."""
    by = {name: row[i][None] for i, name in enumerate(form.columns)}
    zero = jnp.zeros(1, dtype=int)
    return Segments(
        trip=zero, vehicle=zero, time_s=by["time_s"], duration_s=by["duration_s"], distance_m=by["distance_m"],
        speed_start_mps=by["speed_start_mps"], speed_end_mps=by["speed_end_mps"],
        channels={c: by[c] for c in form.channels},
    )  # fmt: skip


def expected(state: State, step: Float[Array, " size"], row: Float[Array, " column"]) -> tuple[Array, Array]:
    """What the kernel predicts of a row at the tabular values, to first order about `step`; and the row's columns x.

    **Returns:** f(θ) − x·δ, and x `[size]`: the Jacobian [target's unit per step], then the levels' columns.
    """
    form, k = state.form, len(state.form.names)
    lower, upper = (jnp.asarray([s[i] for s in form.structure], dtype=float) for i in (2, 3))
    bounded = (upper < UNBOUNDED) & jnp.isfinite(lower)
    edge = EDGE * jnp.where(bounded, jnp.where(bounded, upper - lower, 1.0), state.scale)
    theta = jnp.clip(state.centre + state.scale * step[:k], lower + edge, upper - edge)
    segments = one_row(form, row)
    if state.gears is not None:  # their probabilities have no slope by the coefficients
        segments = state.gears(insert(state.vehicle, form.structure, theta), segments)

    def predict(delta: Array) -> tuple[Array, Array]:
        y = insert(state.vehicle, form.structure, theta + state.scale * delta).predict(segments, form.target)[0]
        return y, y

    x, y = jax.jacfwd(predict, has_aux=True)(jnp.zeros(k))
    at = (theta - state.centre) / state.scale
    return y - x @ at, jnp.concatenate([x, _level_columns(form, row)])


def _level_columns(form: Form, row: Float[Array, " column"]) -> Float[Array, " level"]:
    """What one unit of each level is in the row: of a load 1 kW, of a force 100 N, else of the target itself."""
    if not form.levels:
        return jnp.zeros(0)
    if form.levels == ("constant",):
        return jnp.ones(1)
    at = {c: row[form.columns.index(c)] for c in ("duration_s", "distance_m")}
    joules = jnp.stack([1e3 * at["duration_s"], 100.0 * at["distance_m"]])
    return joules / (J_PER_WH if TARGETS[form.target].weight == "row" else 1e3 * at["duration_s"])


def _whole_row(state: State, row: Array) -> tuple[Array, Array, Array]:
    """The row with its channels' last values where it has none; whether it can be used; what was held."""
    form = state.form
    at = {name: i for i, name in enumerate(form.columns)}
    duration, v0, v1 = row[at["duration_s"]], row[at["speed_start_mps"]], row[at["speed_end_mps"]]
    good = jnp.isfinite(duration) & (duration > 0) & (duration <= LONGEST_S) & jnp.isfinite(row[at["trip"]])
    for v in (v0, v1):
        good &= (v >= -REVERSE_MPS) & (v <= MAX_SPEED_MPS)  # false for NaN
    duration = jnp.where(good, duration, 1.0)
    v0, v1 = (jnp.where(good, jnp.maximum(v, 0.0), 0.0) for v in (v0, v1))
    distance = row[at["distance_m"]]
    lost = ~(jnp.isfinite(distance) & (distance >= 0) & (distance <= 2.0 * MAX_SPEED_MPS * duration))
    distance = jnp.where(lost, 0.5 * (v0 + v1) * duration, distance)
    channels, before = row[len(NEEDED) :], state.last[len(NEEDED) :]
    low, high = (jnp.asarray([RANGES.get(c, (-MOST, MOST))[k] for c in form.channels], dtype=float) for k in (0, 1))
    gone = ~((channels >= low) & (channels <= high))  # also NaN
    channels = jnp.where(gone, before, channels)
    whole = row.at[len(NEEDED) :].set(channels)
    for name, value in (("duration_s", duration), ("distance_m", distance), ("speed_start_mps", v0),
                        ("speed_end_mps", v1)):  # fmt: skip
        whole = whole.at[at[name]].set(value)
    whole = whole.at[at["time_s"]].set(jnp.where(jnp.isfinite(row[at["time_s"]]), row[at["time_s"]], _next(state, at)))
    return whole, good, jnp.concatenate([lost[None], gone & jnp.isfinite(before)])


def _of_power(form: Form, watts: float, duration_s: Array) -> Array:
    """What a power at the battery is in a row, in the target's unit; more than any row has where that is another."""
    target = TARGETS[form.target]
    if not target.of_battery:
        return jnp.full_like(duration_s, math.copysign(MOST, watts))
    return watts * (duration_s / J_PER_WH if target.weight == "row" else jnp.full_like(duration_s, 1e-3))


def _charges(form: Form, row: Array, beyond: Array) -> Array:
    """Whether the row is of charging: the vehicle stands, and more flows into the battery than a sensor's zero is off,
    and than `beyond`, what the rows' noise can show [target's unit]."""
    at = {name: i for i, name in enumerate(form.columns)}
    duration = row[at["duration_s"]]
    moves = jnp.maximum(row[at["speed_start_mps"]], row[at["speed_end_mps"]]) >= STANDS_MPS
    moves |= row[at["distance_m"]] > STANDS_MPS * duration
    return ~moves & (row[at["measured"]] < jnp.minimum(_of_power(form, CHARGES_W, duration), -beyond))


def _next(state: State, at: dict[str, int]) -> Array:
    """When the row after the last begins."""
    end = state.last[at["time_s"]] + state.last[at["duration_s"]]
    return jnp.where(jnp.isfinite(end), end, 0.0)


def update(state: State, row: Float[Any, " column"], candidates: Float[Any, " candidate"] = ()) -> tuple[State, Now]:
    """The state after one row, and what is known at it. A row that cannot be used is counted; the state stays finite.

    **Arguments:** `row`: `[column]`, in the order of `Form.columns` (`packed` makes it). In it `measured` is the target
    and `trip` a number that changes from trip to trip. NaN means missing: a missing channel keeps its last value, and
    a row without the target is only predicted. `candidates`: where effects are watched, what each would add to the row
    (`Watch.columns`).

    After a gap longer than ten rows, or where the clock goes back, errors count as uncorrelated with those before.
    """
    form = state.form
    row, c = (jnp.asarray(v, dtype=state.sums.gram.dtype) for v in (row, candidates))
    at = {name: i for i, name in enumerate(form.columns)}
    whole, good, held = _whole_row(state, row)
    last = state.last[at["trip"]]
    opens = whole[at["trip"]] != last  # also where there was none
    begun = jax.lax.cond(opens & jnp.isfinite(last), on_a_new_trip, lambda s: s, state)
    duration, step = whole[at["duration_s"]], whole[at["time_s"]] - state.last[at["time_s"]]
    usual = jnp.maximum(state.last[at["duration_s"]], duration)
    late = whole[at["time_s"]] - _next(state, at)
    gap = ~opens & (late > (GAP_SAMPLES - 1.0) * usual * (1.0 + 1e-9))
    jumps = ~opens & (step < 0.0)
    begun = aged(begun, jnp.where(opens, 0.0, jnp.maximum(step, 0.0)))
    since = jnp.where(opens | gap | jumps, jnp.inf, begun.since + 1.0)

    mean = begun.weights @ begun.mean
    base, x = expected(begun, mean, whole)
    good &= jnp.isfinite(base) & jnp.all(
        jnp.isfinite(x)
    )  # NaN where the vehicle reads a channel that never had a value
    rho, n = jnp.asarray(form.memories), begun.totals[0]
    fades = jnp.where(jnp.isfinite(since), rho ** jnp.where(jnp.isfinite(since), since, 1.0), 0.0)
    q = (1.0 - fades**2) / (1.0 - rho**2)

    def whitened(new: Array, old: Array) -> Array:
        return (new[None, :] - fades[:, None] * old) / jnp.sqrt(q)[:, None]

    xs, white_c = whitened(x, begun.before[None, :-1]), whitened(c, begun.candidate[None, :])
    # what the rows before say of this one
    own = jnp.where(begun.variance > 0, begun.variance, jnp.maximum((SHARE * base) ** 2, TINY) * (1.0 - rho**2))
    loud, size = _loudness(begun, base + mean @ x) if form.robust else (jnp.ones(()), jnp.zeros(()))
    width = loud * own + jnp.einsum("mi,mij,mj->m", xs, begun.covariance, xs)
    told = base + begun.mean @ x + fades * (begun.before[-1] - begun.mean @ begun.before[:-1])
    weights = begun.weights
    predicted = weights @ told
    spread = weights @ (q * width + (told - predicted) ** 2)
    half = jnp.where(n > 0, _reach(form) * jnp.sqrt(spread), jnp.nan)  # of the first row the noise is not known
    # what it says of them
    heard = (jnp.abs(row[at["measured"]]) <= _of_power(form, MAX_POWER_W, duration)) & good  # false for NaN
    charges = heard & _charges(form, whole, jnp.where(n > 0, FAULT * jnp.sqrt(spread), 0.0))
    heard &= ~charges
    y = jnp.where(heard, row[at["measured"]], 0.0)
    z = jnp.append(x, y - base)
    rs = whitened(z[-1:], begun.before[None, -1:])[:, 0]
    white = jnp.concatenate([xs, rs[:, None]], axis=1)
    far = (y - predicted) ** 2 / spread
    sure = form.robust & (n > 0)  # of the first row nothing is known that it could be far from
    tail = jnp.where(sure, (STUDENT_DF + 1.0) / (STUDENT_DF + far), 1.0)
    weight = tail / loud * heard
    fault = heard & sure & (far > FAULT**2)
    near = heard & ~fault
    error, scale = rs - jnp.sum(xs * begun.mean, axis=1), jnp.sqrt(width)
    density = jax.scipy.stats.t.logpdf(error / scale, STUDENT_DF) if form.robust else -0.5 * (error / scale) ** 2
    density = jnp.where(heard & (n >= ENOUGH), density - jnp.log(scale) - 0.5 * jnp.log(q), 0.0)
    evidence = begun.evidence + density
    clipped = jnp.where(sure, jnp.minimum(error**2, FAULT**2 * width), error**2) * loud * own / width
    score = jnp.where(sure, (tail * error / scale) ** 2, NORMAL_SCORE)

    def running(mean: Array, new: Array) -> Array:
        return jnp.where(heard, (n * mean + new) / (n + 1.0), mean)

    sums = faded(begun, xs, duration / 3600.0) if form.drifts else begun.sums
    # squares of errors over the noise of a row, by how large the target is; large ones do not outweigh the rest
    grown = jnp.stack([1.0, size, size**2, loud * tail * far, loud * tail * far * size]) / (1.0 + size) ** 2
    squares = jnp.concatenate([jnp.ones(1), y[None] ** 2, x[len(form.names) :] ** 2])
    wh = wh_per_unit(form, whole)
    used = eqx.tree_at(
        lambda s: (
            s.sums, s.evidence, s.before, s.candidate, s.since, s.wide, s.score, s.totals, s.growth, s.worth, s.cost_wh,
        ), begun,
        (sums.plus(white, white_c, weight), evidence - jnp.max(evidence), jnp.where(near, z, begun.before),
         jnp.where(near, c, begun.candidate), jnp.where(near, 0.0, since), running(begun.wide, clipped),
         running(begun.score, score), begun.totals + heard * squares,
         begun.growth + jnp.where(heard & (n >= ENOUGH), grown, 0.0), begun.worth + heard / loud,
         begun.cost_wh + c * wh),
    )  # fmt: skip
    counts = state.counts + _counted(held, good, heard, charges, fault, gap, jumps, opens)
    after = eqx.tree_at(lambda s: s.driven_s, whole_posterior(used), used.driven_s + duration * ~charges)
    after = watched(after, (n >= WATCH_ROWS) & heard, counts[0])
    new = jax.tree.map(lambda a, b: jnp.where(good, a, b), after, state)
    lasting = jnp.where(good, whole.at[at["measured"]].set(0.0), state.last)
    new = eqx.tree_at(lambda s: (s.counts, s.last), new, (counts, lasting))
    seen: dict[str, Array] = {
        "predicted": predicted, "lower": predicted - half, "upper": predicted + half, "model": base + mean @ x,
        "energy_wh": predicted * wh,
    }  # fmt: skip
    return new, Now(
        **{k: jnp.where(good, v, jnp.nan) for k, v in seen.items()}, values=new.values, sd=new.sd, sigma=new.sigma,
        memory=new.memory, weight=weight, alarm=jnp.max(new.alarm_at, initial=0.0),
    )  # fmt: skip


def _loudness(state: State, predicted: Array) -> tuple[Array, Array]:
    """Variance of this row's noise over that of a row of no energy, a + b·u; and u, the square of what is predicted
    over the mean square of the target.

    Instruments err in proportion to what they show (`inference.predictive`, growth). By least squares of the squared
    errors so far, of which the first are believed to be alike.
    """
    size = predicted**2 / jnp.maximum(state.totals[1] / jnp.maximum(state.totals[0], 1.0), TINY)
    n, u, uu, e, eu = state.growth + ALIKE * jnp.array([1.0, 1.0, 2.0, 1.0, 1.0])
    slope = jnp.clip((n * eu - u * e) / (n * uu - u**2), 0.0, jnp.maximum(eu / uu, 0.0))
    level = (e - slope * u) / n
    loud = jnp.maximum(level, QUIET) + slope * jnp.minimum(size, LARGE)
    return jnp.where(state.totals[0] > 0, loud, 1.0), jnp.minimum(size, LARGE)


def _reach(form: Form) -> float:
    """Half the interval, in scales of a row."""
    p = 0.5 + form.level / 2.0
    return float(stats.t.ppf(p, STUDENT_DF)) if form.robust else float(stats.norm.ppf(p))


def wh_per_unit(form: Form, row: Array) -> Array:
    """Wh that one unit of the target is in the row."""
    target = TARGETS[form.target]
    weight = {"row": 1.0, "duration": row[form.columns.index("duration_s")],
              "distance": row[form.columns.index("distance_m")]}[target.weight]  # fmt: skip
    return jnp.asarray(weight * 1e3 / target.per_kwh if target.per_kwh else jnp.nan)


def _counted(held: Any, good: Any, heard: Any, charges: Any, fault: Any, gap: Any, jumps: Any, opens: Any) -> Array:
    """What became of the row, in the order of `Form.counts`."""
    own = {"rows": jnp.asarray(True), "used": heard, "unusable": ~good, "unmeasured": good & ~heard & ~charges,
           "charging": charges, "outliers": fault, "gaps": gap & good, "clock_jumps": jumps & good,
           "trips": opens & good}  # fmt: skip
    return jnp.concatenate([jnp.stack([own[c] for c in COUNTS]), held & good]).astype(float)


@eqx.filter_jit
def scan(state: State, rows: Float[Any, "row column"], candidates: Any = None) -> tuple[State, Now]:
    """`update` over rows, one after the other.

    **Arguments:** `rows` `[row, column]`; `candidates` `[row, candidate]`, where effects are watched. **Returns:** the
    state after the last row, and what was known at each row, `Now` with a leading axis `[row]`.
    """
    rows = jnp.asarray(rows)
    each = jnp.zeros((len(rows), 0)) if candidates is None else jnp.asarray(candidates)
    return jax.lax.scan(lambda s, row: update(s, *row), state, (rows, each))
