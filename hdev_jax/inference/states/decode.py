"""Decoding: the states of rows by filter and smoother, and draws of them."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hdev_jax.inference.rows import padded_rows
from hdev_jax.inference.states.chain import draw, smooth
from hdev_jax.inference.states.model import Switching, kept_errors, log_t
from hdev_jax.inference.states.rows import StateRows
from hdev_jax.segments import trip_slices

__all__ = ["Decoded", "decode", "energy_draws"]

LANES = 16  # trips run side by side


class Decoded(NamedTuple):
    """The states of rows: the share of each row that a load is on given all rows of the trip (`on`) and given the rows
    before alone (`ahead`), what the errors before say of a row's own [W] (`error_w`), the probability that a row begins
    and ends in the same joint state (`same`), and the log-likelihood."""

    on: Float[np.ndarray, "row load"]
    ahead: Float[np.ndarray, "row load"]
    error_w: Float[np.ndarray, " row"]
    same: Float[np.ndarray, "row state"]
    log_likelihood: float


class _Lanes(NamedTuple):
    """Where each row is: whole trips one after the other in a few lanes of about the same length."""

    lane: np.ndarray
    place: np.ndarray
    shape: tuple[int, int]
    starts: np.ndarray  # rows that begin a trip

    @classmethod
    def of(cls, trip: np.ndarray) -> "_Lanes":
        slices = [s for _, s in trip_slices(trip)]
        filled = np.zeros(min(LANES, len(slices)), dtype=int)
        lane, place = np.empty(len(trip), dtype=int), np.empty(len(trip), dtype=int)
        for s in sorted(slices, key=lambda s: s.start - s.stop):
            k = int(np.argmin(filled))
            lane[s], place[s] = k, filled[k] + np.arange(s.stop - s.start)
            filled[k] += s.stop - s.start
        longest = int(filled.max())
        # a scan takes as long as its rows: no fewer than 64, and shapes that double up to those of any other program
        size = max(64, 2 ** (longest - 1).bit_length()) if longest <= padded_rows(1) else padded_rows(longest)
        return cls(lane, place, (size, len(filled)), np.array([s.start for s in slices]))

    def spread(self, values: np.ndarray, fill: Any) -> np.ndarray:
        out = np.empty((*self.shape, *values.shape[1:]))
        out[...] = fill
        out[self.place, self.lane] = values
        return out


def _moves(model: Switching, rows: StateRows, starts: np.ndarray) -> Float[np.ndarray, "row state state"]:
    """Chance of each joint state given the one before; a trip's first row has none before it."""
    keep = np.exp(-rows.duration_s[:, None] / model.memory_s)
    keep[starts] = 0.0
    share = model.expected(rows.temp_c)
    out = np.ones((len(rows.trip), 1, 1))
    for k in range(len(model.power_w)):
        p = np.stack([1.0 - share[:, k], share[:, k]], axis=1)
        own = (1.0 - keep[:, k, None, None]) * p[:, None, :] + keep[:, k, None, None] * np.eye(2)
        size = 2 * out.shape[1]
        out = np.einsum("rij,rkl->rikjl", out, own).reshape(len(out), size, size)
    return out


class _Pairs(NamedTuple):
    """Of each row, for each pair of states before and after it: the log-likelihood of its residual where it is at the
    level after it (`whole`), or holds any share of the step alike (`partly`), and the share as measured (`way`)."""

    whole: Float[np.ndarray, "row state state"]
    partly: Float[np.ndarray, "row state state"]
    way: Float[np.ndarray, "row state state"]


def _pairs(model: Switching, rows: StateRows, starts: np.ndarray) -> _Pairs:
    """Densities about the levels, the errors being an autoregression: of a share, flat between the two levels."""
    levels, kept = model.base_w + model.on @ model.power_w, kept_errors(model, rows, starts)
    scale = model.scale_w[rows.standing][:, None, None]
    before = np.r_[0.0, rows.residual_w[:-1]][:, None] - levels  # error of the row before, by the state before
    x = (rows.residual_w[:, None] - kept[:, None] * before)[:, :, None]
    first = np.zeros(len(rows.trip), dtype=bool)
    first[starts] = True  # begins in the state that it ends in
    first = first[:, None, None]
    low, high = (np.where(first, levels, f(levels[:, None], levels)) for f in (np.minimum, np.maximum))
    off = np.maximum(np.maximum(low - x, x - high), 0.0)
    flat = 1.0 + (high - low) / scale * np.exp(log_t(0.0, model.freedom))
    partly = np.log(rows.partly) + log_t(off / scale, model.freedom) - np.log(scale * flat)
    whole = np.log1p(-rows.partly) + log_t((x - levels) / scale, model.freedom) - np.log(scale)
    step = levels[None, :] - levels[:, None]
    way = np.clip((x - levels[:, None]) / np.where(step == 0, 1.0, step), 0.0, 1.0)
    sure = step**2 / (step**2 + 12.0 * scale**2)  # variance of a uniform share over that with the error's
    return _Pairs(whole, partly, np.where(first, 1.0, 0.5 + sure * (way - 0.5)))


def _on_in(model: Switching, pairs: _Pairs) -> Float[np.ndarray, "row state state load"]:
    """The share of each row that each load is on, for each pair of states: all of it, or as measured, by how likely
    either is."""
    partly = np.exp(pairs.partly - np.logaddexp(pairs.whole, pairs.partly))
    way = (1.0 - partly * (1.0 - pairs.way))[..., None]
    return (1.0 - way) * model.on[:, None, :] + way * model.on[None, :, :]


def _posed(model: Switching, rows: StateRows) -> tuple[_Lanes, np.ndarray, np.ndarray, _Pairs]:
    lanes = _Lanes.of(rows.trip)
    moves = lanes.spread(_moves(model, rows, lanes.starts), np.eye(len(model.on)))
    pairs = _pairs(model, rows, lanes.starts)
    return lanes, moves, lanes.spread(np.logaddexp(pairs.whole, pairs.partly), 0.0), pairs


def decode(model: Switching, rows: StateRows) -> Decoded:
    """The states of rows by filter and smoother."""
    lanes, moves, fits, each = _posed(model, rows)
    found = smooth(moves, fits)
    at = lanes.place, lanes.lane
    pairs = np.asarray(found.pairs)[at]
    on = np.einsum("rij,rijk->rk", pairs, _on_in(model, each))
    same = np.einsum("rii->ri", pairs).copy()
    same[lanes.starts] = pairs[lanes.starts].sum(axis=1)  # nothing comes before
    filtered, ahead = (np.asarray(x)[at] @ model.on for x in (found.filtered, found.ahead))
    # half of a row in which it may switch is spent in the state before
    before = np.r_[filtered[:1], filtered[:-1]]
    before[lanes.starts] = ahead[lanes.starts]
    error = np.r_[0.0, (rows.residual_w - model.predicted_w(filtered))[:-1]] * kept_errors(model, rows, lanes.starts)
    return Decoded(on, 0.5 * (before + ahead), error, same, float(np.sum(np.asarray(found.log_likelihood))))


def energy_draws(
    model: Switching, rows: StateRows, *, key: jax.Array, draws: int
) -> Float[np.ndarray, "draw load trip"]:
    """Energy of each load in each trip [Wh] over draws of the state sequence from its posterior."""
    lanes, moves, fits, each = _posed(model, rows)
    filtered, where = smooth(moves, fits).filtered, _on_in(model, each)
    which, at = [s for _, s in trip_slices(rows.trip)], np.arange(len(rows.trip))
    hours = rows.duration_s / 3600.0
    out = np.empty((draws, len(model.power_w), len(which)))
    for k, one in enumerate(jax.random.split(key, draws)):
        after = np.asarray(draw(filtered, moves, fits, key=one))[lanes.place, lanes.lane]
        before = np.r_[after[:1], after[:-1]]
        before[lanes.starts] = after[lanes.starts]
        energy = where[at, before, after] * hours[:, None] * model.power_w
        out[k] = np.stack([energy[s].sum(axis=0) for s in which], axis=1)
    return out
