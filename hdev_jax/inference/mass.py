"""Total mass by trip, or by stop where doors or passengers change it: a posterior from the same kernel in closed form.

Mass enters inertia, slope and rolling resistance, not drag: hills and stops separate it from everything else. c_rr and
drag area are known from the vehicle's calibration within their sds, and every trip adds its own information on them.
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from hdev_jax.inference.calibrate import padded
from hdev_jax.inference.design import LinearFit, Rows, linear_fit
from hdev_jax.inference.identified import caveats
from hdev_jax.inference.parameters import Coefficient, ParameterTable
from hdev_jax.physics import Vehicle
from hdev_jax.segments import Segments
from hdev_jax.targets import TargetName

__all__ = ["MassFit", "loads", "mass_posterior", "with_sd"]


@dataclass(frozen=True)
class MassFit:
    """Mass of each group [kg] with its sd, distance [km], and what the log leaves open of it."""

    mass_kg: Float[np.ndarray, " group"]
    sd_kg: Float[np.ndarray, " group"]
    km: Float[np.ndarray, " group"]
    fit: LinearFit
    notes: list[str]


def loads(segments: Segments, channel: str = "passengers") -> Int[np.ndarray, " row"]:
    """A number for each stretch of a trip over which a channel (passengers, an open door) does not change, from 0.

    A door splits at the end of each time it is open. Raises `KeyError` where the log lacks the channel.
    """
    trip, value = np.asarray(segments.trip), np.asarray(segments.channels[channel])
    changed = np.diff(value) < 0 if channel == "door_open" else np.diff(value) != 0
    return np.cumsum(np.r_[0, (np.diff(trip) != 0) | changed])


def mass_posterior(
    vehicle: Vehicle,
    table: ParameterTable,
    segments: Segments,
    measured: Float[np.ndarray, " row"],
    target: TargetName,
    *,
    mass_kg: float,
    sd_kg: float,
    group: Int[np.ndarray, " row"] | None = None,
    robust: bool = True,
    inflation: float = 1.0,
) -> MassFit:
    """The posterior of the total mass of each group of rows (trips by default), whatever mass the log claims.

    **Arguments:** `table` holds what else is free in the vehicle, with sds as the vehicle's own calibration has them
    (every group has the same prior); `mass_kg`, `sd_kg`: what is known before, empty to full; `inflation`: how many
    rows are worth one independent row (of a calibration). Raises `ValueError` where the chain is not entered at the
    road: behind a measured force or torque mass does not act.
    """
    if vehicle.entry != "road":
        raise ValueError(f"the chain is entered at the {vehicle.entry}: mass acts before it; enter it at the road")
    bare = segments.without("mass_kg")
    car = eqx.tree_at(lambda v: v.mass_kg, vehicle, np.asarray(float(mass_kg)))
    own = Coefficient("mass_kg", "kg", float(mass_kg), float(sd_kg), float(sd_kg), 0.0, np.inf)
    rest = tuple(c for c in table.rows if c.path != "mass_kg")
    ids = np.asarray(segments.trip if group is None else group).astype(int)
    _, ids = np.unique(ids, return_inverse=True)
    fit = padded(bare, measured)
    fit = eqx.tree_at(lambda f: f.weight, fit, np.asarray(fit.weight) / np.sqrt(inflation))
    found = linear_fit(
        car,
        ParameterTable((own, *rest)),
        lambda: [Rows(fit, ids, ids)],
        target,
        groups=int(ids.max()) + 1,
        robust=robust,
    )
    km = np.bincount(ids, weights=np.asarray(segments.distance_m, dtype=float)) / 1e3
    return MassFit(found.values[:, 0], found.sd[:, 0], km, found, _about_mass(found))


def _about_mass(fit: LinearFit) -> list[str]:
    return [line for line in caveats(fit) if "mass_kg" in line or "rows" in line]


def with_sd(table: ParameterTable, values: Any, sd: Any) -> ParameterTable:
    """The table with its free coefficients at these values and sds: a vehicle's calibration as the next prior."""
    from dataclasses import replace

    new = iter(zip(values, sd, strict=True))
    rows = []
    for c in table.rows:
        if c.free:
            v, s = next(new)
            rows.append(replace(c, value=float(v), sd=float(s), scale=float(s)))
        else:
            rows.append(c)
    return ParameterTable(tuple(rows))
