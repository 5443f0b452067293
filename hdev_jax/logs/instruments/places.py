"""Which readings of a log are of one place: the same stretch of road in either direction, by positions."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

__all__ = ["Places", "metres", "places_of"]

EARTH_M = 6_371_008.8  # mean radius of the Earth, IUGG
AHEAD_M = 30.0  # a heading is from so far behind to so far ahead: 4 m of noise at both ends turn it by 5°
TURN = np.cos(np.radians(30.0))  # headings agree or oppose within 30°: six of their standard deviations
# Roads side by side are separate places where positions are good; two lanes in each direction of 3.5 m are one road.
ROAD_M, WIDEST_M = 10.0, 50.0
NEAREST = 8  # places about a cell that it may be of: neighbours on one road, and on those that cross it
LAP_M = 4.0 * WIDEST_M  # a way that comes back to within 50 m after more than a circle about them is another pass
SOME = 500  # cells that the positions' noise is from: a median of so many is known to 6 %
GONE = 0.5  # positions that moved by less than half of the way, or by half more, are frozen or wrong


@dataclass(frozen=True)
class Places:
    """The place of each cell (−1: none), how far ahead on the cell's way it lies, whether that is the way of the first
    pass there (1) or the opposite one (−1); and the noise of positions across the road."""

    place: Int[np.ndarray, " cell"]
    ahead_m: Float[np.ndarray, " cell"]
    way: Float[np.ndarray, " cell"]
    sd_m: float


def metres(latitude_deg: np.ndarray, longitude_deg: np.ndarray) -> Float[np.ndarray, "row 2"]:
    """East and north of the middle of the log; NaN where there is no position: none, 0/0, or none on Earth."""
    lat, lon = np.asarray(latitude_deg, dtype=float), np.asarray(longitude_deg, dtype=float)
    there = (np.abs(lat) <= 90.0) & (np.abs(lon) <= 360.0) & ((lat != 0.0) | (lon != 0.0))
    if not there.any():
        return np.full((len(lat), 2), np.nan)
    middle = float(np.median(lat[there]))
    east = (lon - lon[there][0] + 180.0) % 360.0 - 180.0
    xy = EARTH_M * np.radians(np.c_[np.cos(np.radians(middle)) * east, lat - middle])
    return np.where(there[:, None], xy, np.nan)


def places_of(
    part: Int[np.ndarray, " cell"], at_m: Float[np.ndarray, " cell"], where: Float[np.ndarray, "cell 2"], cell_m: float
) -> Places | None:
    """Places, `cell_m` or more apart along roads, and which cells are of each: the positions `where` [m] are no further
    aside than their noise explains, on the same way or the opposite one. None where no road was driven twice."""
    heading = _headings(part, at_m, where)
    known = np.isfinite(heading[:, 0])
    cells = np.flatnonzero(known)
    if len(cells) < 2:
        return None
    where, heading, part, at_m = where[cells], heading[cells], part[cells], at_m[cells]
    tree = KDTree(where)
    sd = _noise(tree, where, heading, part, at_m, cell_m)
    if sd is None:
        return None
    reach = float(np.clip(3.0 * np.sqrt(2.0) * sd, ROAD_M, WIDEST_M))  # both positions have the noise
    radius = float(np.hypot(reach, cell_m))
    free, chosen = np.ones(len(cells), bool), []
    for k in range(len(cells)):  # a cell that is of no place yet makes one; each place asks for its cells once
        if free[k]:
            near = np.asarray(tree.query_ball_point(where[k], radius))
            free[near[_same(where[near] - where[k], heading[k], heading[near], cell_m, reach)[0]]] = False
            chosen.append(k)
    points = np.array(chosen)
    found = KDTree(where[points]).query(where, k=min(NEAREST, len(points)), distance_upper_bound=radius)[1]
    found = found.reshape(len(cells), -1)
    at = points[np.minimum(found, len(points) - 1)]
    same, ahead, _ = _same(where[at] - where[:, None], heading[:, None], heading[at], cell_m, reach)
    same &= found < len(points)
    best = np.argmax(same, axis=1)  # the nearest that fits
    rows = np.arange(len(cells))
    size = len(known)
    out, far, way = np.full(size, -1), np.zeros(size), np.ones(size)
    out[cells] = np.where(same[rows, best], found[rows, best], -1)
    far[cells] = np.where(same[rows, best], ahead[rows, best], 0.0)
    way[cells] = np.where(np.sum(heading[at[rows, best]] * heading, axis=1) < 0, -1.0, 1.0)
    return Places(out, far, way, sd)


def _same(
    off: np.ndarray, heading: np.ndarray, other: np.ndarray, cell_m: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether what is `off` by so much [m] is on one road with a `heading`; how far ahead and how far aside it is."""
    ahead = np.sum(off * heading, axis=-1)
    aside = np.abs(off[..., 0] * heading[..., 1] - off[..., 1] * heading[..., 0])
    same = (np.abs(np.sum(heading * other, axis=-1)) > TURN) & (aside < reach) & (np.abs(ahead) <= cell_m)
    return same, ahead, aside


def _headings(part: np.ndarray, at_m: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Unit vectors along the way `[cell, 2]`; NaN where there is no position, or it did not move as the vehicle did."""
    there = np.isfinite(where[:, 0])
    if not there.any():
        return np.full(where.shape, np.nan)
    seen = np.flatnonzero(there)
    edge = np.flatnonzero(np.r_[True, np.diff(part[seen]) != 0])
    number = np.searchsorted(edge, np.arange(len(seen)), side="right") - 1
    low, high = at_m[seen][edge][number], at_m[seen][np.r_[edge[1:], len(seen)] - 1][number]
    line = at_m[seen] + 1e7 * number  # parts on one line, further apart than any is long
    ends = [np.clip(at_m[seen] + x, low, high) for x in (-AHEAD_M, AHEAD_M)]
    back, front = (np.stack([np.interp(x + 1e7 * number, line, where[seen, c]) for c in (0, 1)], axis=1) for x in ends)
    way, moved = ends[1] - ends[0], np.hypot(*(front - back).T)
    good = (way >= AHEAD_M) & (np.abs(moved - way) < GONE * way)
    out = np.full(where.shape, np.nan)
    out[seen[good]] = ((front - back) / np.maximum(moved, 1e-9)[:, None])[good]
    return out


def _noise(
    tree: KDTree, where: np.ndarray, heading: np.ndarray, part: np.ndarray, at_m: np.ndarray, cell_m: float
) -> float | None:  # fmt: skip
    """Standard deviation of positions across the road, by how far passes of other parts, or of this one on its way back
    or a lap later, lie aside; None where there are none."""
    some = np.unique(np.linspace(0, len(where) - 1, min(SOME, len(where))).astype(int))
    found = tree.query_ball_point(where[some], WIDEST_M)
    k, j = np.repeat(some, [len(x) for x in found]), np.concatenate([np.asarray(x, int) for x in found])
    same, _, aside = _same(where[j] - where[k], heading[k], heading[j], cell_m, WIDEST_M)
    later = np.abs(at_m[k] - at_m[j]) > LAP_M
    same &= (part[k] != part[j]) | later | (np.sum(heading[k] * heading[j], axis=1) < 0)
    return float(1.4826 * np.median(aside[same]) / np.sqrt(2.0)) if same.any() else None
