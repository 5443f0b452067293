"""Decoding: the states of rows by filter and smoother, and draws of them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.inference.states.chain import draw, smooth
from hdev_jax.inference.states.lanes import Lanes
from hdev_jax.inference.states.model import Switching, kept_errors, log_t, scales
from hdev_jax.inference.states.rows import StateRows
from hdev_jax.segments import trip_slices

__all__ = ["Decoded", "decode", "energy_draws"]

MOST_PLACES = 2**18  # rows in lanes at a time: of two loads half a gigabyte
FURTHEST = 1e9  # 1 + x²/freedom of an error beyond which any further is as unlikely


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


class _Levels(NamedTuple):
    """The level of each joint state [W] and which loads are on in it; of Student's density the degrees of freedom and
    its value at 0; the chance that a row in which a load switches holds a share of it."""

    level_w: Float[Array, " state"]
    on: Float[Array, "state load"]
    freedom: Float[Array, ""]
    density: Float[Array, ""]
    partly: Float[Array, ""]


class _Laid(NamedTuple):
    """Rows in their lanes: the residual, how much of the error before is kept, the scale of the error, the chance that
    each load keeps its state whatever its share of time on, that share; whether a row begins a trip, and is one."""

    residual_w: Float[Array, "row lane"]
    kept: Float[Array, "row lane"]
    scale: Float[Array, "row lane"]
    keep: Float[Array, "row lane load"]
    share: Float[Array, "row lane load"]
    first: Float[Array, "row lane"]
    real: Float[Array, "row lane"]


class _Posed(NamedTuple):
    """Of each row, for each pair of states before and after it: the chance of the move, the likelihood of the
    residual, the probability that the row holds a share of the step and not all of it (`partly`), that share as
    measured (`way`) and its standard deviation (`way_sd`)."""

    moves: Float[Array, "row lane state state"]
    fits: Float[Array, "row lane state state"]
    partly: Float[Array, "row lane state state"]
    way: Float[Array, "row lane state state"]
    way_sd: Float[Array, "row lane state state"]


def _to_halves(x: Array, halves: Array) -> Array:
    """x to the power of a whole number of halves below 64, without a logarithm of every row: a tenth of the time."""
    out, root, left = jnp.ones_like(x), jnp.sqrt(x), halves.astype(int)
    for bit in range(6):
        out = jnp.where(left >> bit & 1, out * root, out)
        root = root * root
    return out


@jax.jit
def _posed(model: _Levels, rows: _Laid) -> _Posed:
    """Chances of moves, and densities about the levels, the errors being an autoregression: of a share, flat between
    the two levels."""
    moves = jnp.ones((*rows.kept.shape, 1, 1))
    for k in range(model.on.shape[1]):
        p, keep = rows.share[..., k], rows.keep[..., k, None, None]
        own = (1.0 - keep) * jnp.stack([1.0 - p, p], axis=-1)[..., None, :] + keep * jnp.eye(2)[None, None]
        size = 2 * moves.shape[-1]
        moves = (moves[..., :, None, :, None] * own[..., None, :, None, :]).reshape(*rows.kept.shape, size, size)
    real = rows.real[..., None, None] > 0
    moves = jnp.where(real, moves, jnp.eye(len(model.level_w))[None, None])

    def density(x: Array) -> Array:
        return model.density / _to_halves(jnp.minimum(1.0 + x**2 / model.freedom, FURTHEST), model.freedom + 1.0)

    scale, before, after = (
        rows.scale[..., None, None],
        model.level_w[None, None, :, None],
        model.level_w[None, None, None],
    )
    first = rows.first[..., None, None] > 0  # begins in the state that it ends in
    last = jnp.concatenate([jnp.zeros_like(rows.residual_w[:1]), rows.residual_w[:-1]])
    # less what is kept of the error of the row before, by the state before
    x = rows.residual_w[..., None, None] - rows.kept[..., None, None] * (last[..., None, None] - before)
    low, high = (jnp.where(first, after, f(before, after)) for f in (jnp.minimum, jnp.maximum))
    off = jnp.maximum(jnp.maximum(low - x, x - high), 0.0)
    partly = model.partly * density(off / scale) / (scale + (high - low) * model.density)
    fits = partly + (1.0 - model.partly) * density((x - after) / scale) / scale
    step = after - before
    way = jnp.clip((x - before) / jnp.where(step == 0, 1.0, step), 0.0, 1.0)
    sure = step**2 / (step**2 + 12.0 * scale**2)  # variance of a uniform share over that with the error's
    way_sd = jnp.where(~first & (step != 0), jnp.sqrt((1.0 - sure) / 12.0), 0.0)
    way = jnp.where(first, 1.0, 0.5 + sure * (way - 0.5))
    return _Posed(moves, jnp.where(real, fits, 1.0), partly / fits, way, way_sd)


class _Found(NamedTuple):
    """What `Decoded` is made of, in lanes."""

    on: Float[Array, "row lane load"]
    ahead: Float[Array, "row lane load"]
    filtered: Float[Array, "row lane load"]
    same: Float[Array, "row lane state"]
    moves: Float[Array, "row lane load before after"]
    log_likelihood: Float[Array, ""]


@jax.jit
def _decoded(model: _Levels, rows: _Laid) -> _Found:
    posed = _posed(model, rows)
    found = smooth(posed.moves, posed.fits)
    before, after = model.on[None, None, :, None], model.on[None, None, None]
    # all of a row is in the state after it, or a share as measured, by how likely either is
    way = (1.0 - posed.partly * (1.0 - posed.way))[..., None]
    on = jnp.sum(found.pairs[..., None] * ((1.0 - way) * before + way * after), axis=(2, 3))
    same = jnp.where(
        rows.first[..., None] > 0, jnp.sum(found.pairs, axis=2), jnp.diagonal(found.pairs, axis1=2, axis2=3)
    )  # nothing comes before a trip
    # joint states count in binary: a load's own moves are sums over all other loads
    loads = model.on.shape[1]
    binary = found.pairs.reshape(*found.pairs.shape[:2], *(2,) * (2 * loads))
    each = [jnp.sum(binary, axis=[2 + j for j in range(2 * loads) if j % loads != k]) for k in range(loads)]
    moves = jnp.stack(each, axis=2)
    total = jnp.sum(found.log_likelihood)
    return _Found(on, found.ahead @ model.on, found.filtered @ model.on, same, moves, total)


def _laid(model: Switching, rows: StateRows) -> tuple[Lanes, _Levels, _Laid]:
    """The rows in lanes, as the model has them."""
    lanes = Lanes.of(rows.trip)
    first = np.zeros(len(rows.trip))
    first[lanes.starts] = 1.0
    # a trip's first row has no state before it
    keep = np.exp(-rows.duration_s[:, None] / model.memory_s) * (1.0 - first[:, None])
    kept, scale = (f(model, rows, lanes.starts) for f in (kept_errors, scales))
    columns = (rows.residual_w, kept, scale, keep, model.expected(rows), first, np.ones(len(first)))
    fills = (0.0, 0.0, 1.0, 1.0, 0.5, 0.0, 0.0)
    laid = _Laid(*(jnp.asarray(lanes.spread(c, fill)) for c, fill in zip(columns, fills, strict=True)))
    level = model.base_w + model.on @ model.power_w
    top = np.exp(log_t(0.0, model.freedom))
    numbers = [jnp.asarray(np.asarray(x, dtype=float)) for x in (level, model.on, model.freedom, top, rows.partly)]
    return lanes, _Levels(*numbers), laid


def decode(model: Switching, rows: StateRows) -> Decoded:
    """The states of rows by filter and smoother."""
    parts = [_decode(model, rows.take(s)) for s in _parts(rows.trip)]
    if len(parts) == 1:
        return parts[0]
    on, ahead, error_w, same, moves = (np.concatenate(c) for c in zip(*(p[:-1] for p in parts), strict=True))
    return Decoded(on, ahead, error_w, same, moves, sum(p.log_likelihood for p in parts))


def _parts(trip: np.ndarray) -> list[slice]:
    """Rows of whole trips that take no more memory at a time than `MOST_PLACES` in lanes, where trips allow it."""
    starts = [s.start for _, s in trip_slices(trip)]
    rows, lanes = Lanes.of(trip).shape
    if rows * lanes <= MOST_PLACES or len(starts) == 1:
        return [slice(0, len(trip))]
    half = starts[len(starts) // 2]
    later = (slice(half + s.start, half + s.stop) for s in _parts(trip[half:]))
    return [*_parts(trip[:half]), *later]


def _decode(model: Switching, rows: StateRows) -> Decoded:
    lanes, levels, laid = _laid(model, rows)
    found = _decoded(levels, laid)
    on, ahead, filtered, same, moves = (np.asarray(x)[lanes.place, lanes.lane] for x in found[:-1])
    # half of a row in which it may switch is spent in the state before
    before = np.r_[filtered[:1], filtered[:-1]]
    before[lanes.starts] = ahead[lanes.starts]
    error = np.r_[0.0, (rows.residual_w - model.predicted_w(filtered))[:-1]] * kept_errors(model, rows, lanes.starts)
    return Decoded(on, 0.5 * (before + ahead), error, same, moves, float(found.log_likelihood))


def energy_draws(model: Switching, rows: StateRows, *, seed: int, draws: int) -> Float[np.ndarray, "draw load trip"]:
    """Energy of each load in each trip [Wh] over draws of the state sequence from its posterior."""
    parts = [_drawn(model, rows.take(s), seed + k, draws) for k, s in enumerate(_parts(rows.trip))]
    return np.concatenate(parts, axis=2)


def _drawn(model: Switching, rows: StateRows, seed: int, draws: int) -> Float[np.ndarray, "draw load trip"]:
    lanes, levels, laid = _laid(model, rows)
    posed = _posed(levels, laid)
    filtered, at, rng = smooth(posed.moves, posed.fits).filtered, np.arange(len(rows.trip)), np.random.default_rng(seed)
    partly, share, share_sd = (np.asarray(x)[lanes.place, lanes.lane] for x in posed[2:])
    which, hours = [s for _, s in trip_slices(rows.trip)], rows.duration_s / 3600.0
    out = np.empty((draws, len(model.power_w), len(which)))
    for k, one in enumerate(jax.random.split(jax.random.key(seed), draws)):
        after = np.asarray(draw(filtered, posed.moves, posed.fits, key=one))[lanes.place, lanes.lane]
        before = np.r_[after[:1], after[:-1]]
        before[lanes.starts] = after[lanes.starts]
        pair = at, before, after
        # a row in which a load switches holds a share of it, as well as that is measured
        way = np.clip(share[pair] + share_sd[pair] * rng.standard_normal(len(at)), 0.0, 1.0)
        way = np.where(rng.random(len(at)) < partly[pair], way, 1.0)[:, None]
        on = (1.0 - way) * model.on[before] + way * model.on[after]
        energy = on * hours[:, None] * model.power_w
        out[k] = np.stack([energy[s].sum(axis=0) for s in which], axis=1)
    return out
