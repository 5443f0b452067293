"""Decoding: the states of rows by filter and smoother, and draws of them."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hdev_jax.inference.states.chain import draw, smooth
from hdev_jax.inference.states.lanes import Lanes
from hdev_jax.inference.states.model import Switching, kept_errors, log_t, scales
from hdev_jax.inference.states.rows import StateRows
from hdev_jax.segments import trip_slices

__all__ = ["Decoded", "decode", "energy_draws", "kept_states"]


class Decoded(NamedTuple):
    """The states of rows: the share of each row that a load is on given all rows of the trip (`on`) and given the rows
    before alone (`ahead`), what the errors before say of a row's own [W] (`error_w`), the probability that a row begins
    and ends in the same joint state (`same`), that each load goes from one state to another (`moves`), and the
    log-likelihood."""

    on: Float[np.ndarray, "row load"]
    ahead: Float[np.ndarray, "row load"]
    error_w: Float[np.ndarray, " row"]
    same: Float[np.ndarray, "row state"]
    moves: Float[np.ndarray, "row load before after"]
    log_likelihood: float


def kept_states(model: Switching, rows: StateRows) -> Float[np.ndarray, "row load"]:
    """The chance that a load keeps its state over a row, whatever its share of time on; a trip's first row has no state
    before it."""
    keep = np.exp(-rows.duration_s[:, None] / model.memory_s)
    keep[np.r_[True, np.diff(rows.trip) != 0]] = 0.0
    return keep


def _moves(model: Switching, rows: StateRows) -> Float[np.ndarray, "row state state"]:
    """Chance of each joint state given the one before."""
    keep = kept_states(model, rows)
    share = model.expected(rows)
    out = np.ones((len(rows.trip), 1, 1))
    for k in range(len(model.power_w)):
        p = np.stack([1.0 - share[:, k], share[:, k]], axis=1)
        own = (1.0 - keep[:, k, None, None]) * p[:, None, :] + keep[:, k, None, None] * np.eye(2)
        size = 2 * out.shape[1]
        out = np.einsum("rij,rkl->rikjl", out, own).reshape(len(out), size, size)
    return out


class _Pairs(NamedTuple):
    """Of each row, for each pair of states before and after it: the log-likelihood of its residual where it is at the
    level after it (`whole`), or holds any share of the step alike (`partly`), the share as measured (`way`) and its
    standard deviation (`way_sd`)."""

    whole: Float[np.ndarray, "row state state"]
    partly: Float[np.ndarray, "row state state"]
    way: Float[np.ndarray, "row state state"]
    way_sd: Float[np.ndarray, "row state state"]


def _pairs(model: Switching, rows: StateRows, starts: np.ndarray) -> _Pairs:
    """Densities about the levels, the errors being an autoregression: of a share, flat between the two levels."""
    levels, kept = model.base_w + model.on @ model.power_w, kept_errors(model, rows, starts)
    scale = scales(model, rows, starts)[:, None, None]
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
    way_sd = np.where(~first & (step != 0), np.sqrt((1.0 - sure) / 12.0), 0.0)
    return _Pairs(whole, partly, np.where(first, 1.0, 0.5 + sure * (way - 0.5)), way_sd)


def _on_in(model: Switching, pairs: _Pairs) -> Float[np.ndarray, "row state state load"]:
    """The share of each row that each load is on, for each pair of states: all of it, or as measured, by how likely
    either is."""
    partly = np.exp(pairs.partly - np.logaddexp(pairs.whole, pairs.partly))
    way = (1.0 - partly * (1.0 - pairs.way))[..., None]
    return (1.0 - way) * model.on[:, None, :] + way * model.on[None, :, :]


def _posed(model: Switching, rows: StateRows) -> tuple[Lanes, np.ndarray, np.ndarray, _Pairs]:
    lanes = Lanes.of(rows.trip)
    moves = lanes.spread(_moves(model, rows), np.eye(len(model.on)))
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
    lit = np.stack([1.0 - model.on, model.on], axis=-1)  # of a joint state, each load's own
    each_moves = np.einsum("rij,ika,jkb->rkab", pairs, lit, lit, optimize=True)
    filtered, ahead = (np.asarray(x)[at] @ model.on for x in (found.filtered, found.ahead))
    # half of a row in which it may switch is spent in the state before
    before = np.r_[filtered[:1], filtered[:-1]]
    before[lanes.starts] = ahead[lanes.starts]
    error = np.r_[0.0, (rows.residual_w - model.predicted_w(filtered))[:-1]] * kept_errors(model, rows, lanes.starts)
    return Decoded(on, 0.5 * (before + ahead), error, same, each_moves, float(np.sum(np.asarray(found.log_likelihood))))


def energy_draws(model: Switching, rows: StateRows, *, seed: int, draws: int) -> Float[np.ndarray, "draw load trip"]:
    """Energy of each load in each trip [Wh] over draws of the state sequence from its posterior."""
    lanes, moves, fits, each = _posed(model, rows)
    filtered, at, rng = smooth(moves, fits).filtered, np.arange(len(rows.trip)), np.random.default_rng(seed)
    which, hours = [s for _, s in trip_slices(rows.trip)], rows.duration_s / 3600.0
    partly = np.exp(each.partly - np.logaddexp(each.whole, each.partly))
    out = np.empty((draws, len(model.power_w), len(which)))
    for k, one in enumerate(jax.random.split(jax.random.key(seed), draws)):
        after = np.asarray(draw(filtered, moves, fits, key=one))[lanes.place, lanes.lane]
        before = np.r_[after[:1], after[:-1]]
        before[lanes.starts] = after[lanes.starts]
        pair = at, before, after
        # a row in which a load switches holds a share of it, as well as that is measured
        way = np.clip(each.way[pair] + each.way_sd[pair] * rng.standard_normal(len(at)), 0.0, 1.0)
        way = np.where(rng.random(len(at)) < partly[pair], way, 1.0)[:, None]
        on = (1.0 - way) * model.on[before] + way * model.on[after]
        energy = on * hours[:, None] * model.power_w
        out[k] = np.stack([energy[s].sum(axis=0) for s in which], axis=1)
    return out
