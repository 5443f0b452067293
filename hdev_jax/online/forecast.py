"""Energy of the rest of the trip, from expected rows, with an interval that narrows as the trip goes on."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import stats

from hdev_jax.online.form import NEEDED
from hdev_jax.online.state import State
from hdev_jax.online.sums import BELIEVED, TRIPS, finished_trips, level_kept, levels_prior, on_a_new_trip
from hdev_jax.online.update import expected, wh_per_unit

__all__ = ["Forecast", "forecast"]


SHORTEST = 64  # rows


@dataclass(frozen=True)
class Forecast:
    """Energy of the rows to come [Wh]: a Student t about `energy_wh` with `scale` and `freedom` degrees of freedom.

    `level`: probability inside its intervals. `parts`: the standard deviations [Wh] that add up in quadrature to
    `scale`: of the coefficients with the trip's level, and of the noise of rows. `soc`, `capacity_wh`: of the battery,
    where they are known.
    """

    energy_wh: float
    scale: float
    freedom: float
    level: float
    parts: dict[str, float]
    soc: float | None = None
    capacity_wh: float | None = None

    @property
    def interval_wh(self) -> tuple[float, float]:
        """Lower and upper end of the interval."""
        half = self.scale * float(stats.t.ppf(0.5 + self.level / 2.0, self.freedom))
        return self.energy_wh - half, self.energy_wh + half

    @property
    def soc_at_end(self) -> tuple[float, float, float] | None:
        """State of charge at the end with its interval, None if unknown. Below 0 the battery does not hold enough."""
        if self.soc is None or self.capacity_wh is None:
            return None
        low, high = self.interval_wh
        soc, whole = self.soc, self.capacity_wh
        return soc - self.energy_wh / whole, soc - high / whole, soc - low / whole

    def chance_of_arriving(self, reserve: float = 0.0) -> float | None:
        """Probability that the state of charge at the end is above `reserve` (0…1); None if it is unknown."""
        if self.soc is None or self.capacity_wh is None:
            return None
        left = (self.soc - reserve) * self.capacity_wh
        return float(stats.t.cdf((left - self.energy_wh) / max(self.scale, 1e-12), self.freedom))


def forecast(
    state: State,
    rows: Float[Any, "row column"],
    *,
    same_trip: bool = True,
    capacity_wh: float | None = None,
    soc: float | None = None,
) -> Forecast:
    """Energy of expected rows. The interval covers the coefficients, the trip's level and correlated errors of rows.

    The expected speeds and weather count as certain: the interval does not cover a speed or a wind that turns out
    otherwise.

    **Arguments:** `rows` `[row, column]`, in the order of `Form.columns`, with the expected speeds, slopes and weather;
    a channel that is NaN keeps its last value, and `measured` is not read. `same_trip`: the rows continue the present
    trip; else they are a new trip. `capacity_wh`: of the battery. `soc`: now, 0…1; by default the last that was logged.

    **Raises:** `ValueError` for rows without a duration or speeds.
    """
    form = state.form
    rows = np.array(rows, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != len(form.columns) or not len(rows):
        raise ValueError(f"rows of the columns {', '.join(form.columns)} are expected, found a shape {rows.shape}")
    at = {c: i for i, c in enumerate(form.columns)}
    need = [at[c] for c in ("duration_s", "speed_start_mps", "speed_end_mps")]
    if not np.all(np.isfinite(rows[:, need])) or not np.all(rows[:, at["duration_s"]] > 0):
        raise ValueError("every row ahead has a duration above 0 and the speeds at both ends; found one that has not")
    distance = 0.5 * rows[:, need[0]] * (rows[:, need[1]] + rows[:, need[2]])
    rows[:, at["distance_m"]] = np.where(np.isfinite(x := rows[:, at["distance_m"]]), x, distance)
    channels, last = rows[:, len(NEEDED) :], np.asarray(state.last)[len(NEEDED) :]
    rows[:, len(NEEDED) :] = np.where(np.isfinite(channels), channels, np.where(np.isfinite(last), last, 0.0))
    size = max(SHORTEST, 1 << (len(rows) - 1).bit_length())  # few shapes, few programs
    counts = np.arange(size) < len(rows)
    rows = np.concatenate([rows, np.repeat(rows[-1:], size - len(rows), axis=0)])
    mean, open_, noise = (float(x) for x in _total(state, jnp.asarray(rows), jnp.asarray(counts), same_trip))
    trips = float(finished_trips(state))
    freedom = TRIPS + trips if form.levels else BELIEVED + float(state.totals[0])
    if soc is None and "soc" in form.channels:
        logged = float(state.last[at["soc"]])
        soc = logged if np.isfinite(logged) else None
    parts = {"coefficients_wh": float(np.sqrt(open_)), "rows_wh": float(np.sqrt(noise))}
    return Forecast(mean, float(np.sqrt(open_ + noise)), freedom, form.level, parts, soc, capacity_wh)


@eqx.filter_jit
def _total(state: State, rows: Array, counts: Array, same_trip: bool) -> tuple[Array, Array, Array]:
    """Sum of the rows [Wh], and its variances: what coefficients leave open, the rows' own noise."""
    state = state if same_trip else on_a_new_trip(state)
    form = state.form
    step = state.weights @ state.mean
    base, x = jax.vmap(lambda row: expected(state, step, row))(rows)
    wh = counts * jax.vmap(lambda row: wh_per_unit(form, row))(rows)
    rho = jnp.asarray(form.memories)
    ahead = jnp.where(jnp.isfinite(state.since), state.since, 0.0) + 1.0
    lasting = rho[:, None] ** (ahead + jnp.arange(rows.shape[0]))[None, :] * jnp.isfinite(state.since)
    seconds = jnp.cumsum(rows[:, form.columns.index("duration_s")]) * same_trip
    kept = jax.vmap(lambda s: level_kept(form, s))(seconds)
    carried = lasting @ wh  # of the last row's error
    weighed = wh[:, None] * x
    k = len(form.names)
    levels = jnp.einsum("rml,rl->ml", kept, weighed[:, k:])
    whole = jnp.concatenate([jnp.broadcast_to(jnp.sum(weighed[:, :k], axis=0), (len(rho), k)), levels], axis=1)
    along = whole - carried[:, None] * state.before[None, :-1]
    total = wh @ base + carried * state.before[-1] + jnp.sum(along * state.mean, axis=1)

    def back(sum_: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        """What one innovation of a row, or of a level, adds to the sum of the rows from it on."""
        return (new := row[0] + row[1] * sum_), new

    _, reach = jax.lax.scan(back, jnp.zeros_like(rho), (wh, jnp.broadcast_to(rho, (len(rows), len(rho)))), reverse=True)
    own = state.wide if form.robust else state.variance
    noise = own * jnp.sum(reach**2, axis=0)
    open_ = jnp.einsum("mi,mij,mj->m", along, state.covariance, along)
    if form.levels:
        step = jax.vmap(lambda s: level_kept(form, s))(rows[:, form.columns.index("duration_s")])
        column = jnp.broadcast_to(weighed[:, None, k:], step.shape)
        _, reach = jax.lax.scan(back, jnp.zeros(step.shape[1:]), (column, jnp.roll(step, -1, axis=0)), reverse=True)
        open_ = open_ + jnp.einsum("rml,l->m", (1.0 - step**2) * reach**2, levels_prior(state))
    w = state.weights
    mean = w @ total
    return mean, w @ (open_ + (total - mean) ** 2), w @ noise
