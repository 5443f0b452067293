"""The gear as a surrogate: features of a row, trees that tell the gear, and the channel that the kernel reads.

Paper 1, section 3.1: speed, requested torque and mass. What the sheet knows makes these comparable between vehicles: the
motor speed that each gear would give and the power that is requested, over rated, and how many gears there are.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.errors import InputError
from hdev_jax.learn.trees import Trees
from hdev_jax.physics import GEAR_PROBABILITY, Vehicle
from hdev_jax.segments import Segments

__all__ = ["FEATURES", "MOST_GEARS", "Gearbox", "Surrogate", "features", "filtered", "in_gears", "markov", "requested_torque"]

MOST_GEARS = 12
_PAPER = ("speed_mps", "requested_torque_nm", "mass_kg")
_SHEET = ("gears", "power_over_rated", *(f"motor_speed_over_rated_{g}" for g in range(1, MOST_GEARS + 1)))
# By what is known: the paper's three; with the vehicle's sheet; with the slope of the road besides.
FEATURES = {"paper": _PAPER, "sheet": (*_PAPER, *_SHEET), "road": (*_PAPER, *_SHEET, "grade_rad")}


class Gearbox(eqx.Module):
    """What the sheet says of gears and motor. `ratio_radpm` [gear]: motor speed over road speed, from the first gear.

    `rated_w` and `rated_radps`: the motor's rated power and the speed at which it first gives it.
    """

    ratio_radpm: Float[Array, " gear"]
    rated_w: Any
    rated_radps: Any
    wheel_radius_m: Any

    def __init__(self, ratios: Any, final_drive: float, wheel_radius_m: float, rated_w: float, rated_radps: float):
        if not 1 <= len(ratios) <= MOST_GEARS:
            raise InputError(f"gearbox: {len(ratios)} gears; 1 to {MOST_GEARS} are expected")
        self.ratio_radpm = jnp.asarray(ratios, dtype=float) * (final_drive / wheel_radius_m)
        self.rated_w, self.rated_radps = jnp.asarray(rated_w, dtype=float), jnp.asarray(rated_radps, dtype=float)
        self.wheel_radius_m = jnp.asarray(wheel_radius_m, dtype=float)

    @property
    def gears(self) -> int:
        """How many there are."""
        return self.ratio_radpm.shape[0]


def requested_torque(vehicle: Vehicle, segments: Segments) -> Float[Array, " row"]:
    """Torque asked for at the wheels [Nm]: the log's, else the kernel's force times the radius of the wheel."""
    if segments.has("requested_torque_nm"):
        return jnp.asarray(segments.channels["requested_torque_nm"])
    return vehicle.force(segments) * vehicle.driveline.wheel_radius_m


def features(names: tuple[str, ...], box: Gearbox, segments: Segments, torque_nm: Array) -> Float[Array, "row feature"]:
    """Columns of `FEATURES` [row, feature], float32. A gear that the box lacks turns the motor at 0.

    **Raises:** `ValueError` for an unknown name; `KeyError` for a channel that the log lacks.
    """
    speed = jnp.asarray(segments.speed_mps)
    columns = []
    for name in names:
        match name.rpartition("_"):
            case _, _, "gears":
                x: Any = jnp.full(speed.shape, float(box.gears))
            case "motor_speed_over_rated", _, g:
                ratio = box.ratio_radpm[int(g) - 1] if int(g) <= box.gears else 0.0
                x = speed * (ratio / box.rated_radps)
            case _ if name == "speed_mps":
                x = speed
            case _ if name == "requested_torque_nm":
                x = torque_nm
            case _ if name == "power_over_rated":
                x = torque_nm * (speed / (box.wheel_radius_m * box.rated_w))
            case _ if name in ("mass_kg", "grade_rad"):
                x = jnp.asarray(segments.channels[name])
            case _:
                raise ValueError(f"no gear feature {name!r}; they are {', '.join(FEATURES['road'])}")
        columns.append(x.astype(jnp.float32))
    return jnp.stack(columns, axis=1)


class Surrogate(eqx.Module):
    """Trees that tell the gear of a row of one vehicle. `of` a model that was trained on several gearboxes.

    **Raises:** `InputError` for features that are not of `FEATURES`, and where the box has a gear that was missing from
    training.
    """

    trees: Trees
    box: Gearbox
    column: tuple[int, ...] = eqx.field(static=True)  # of the trees' classes, by gear

    @staticmethod
    def of(trees: Trees, box: Gearbox) -> "Surrogate":
        """The surrogate for this gearbox."""
        known = {int(c): k for k, c in enumerate(trees.classes)}
        if odd := [n for n in trees.features if n not in FEATURES["road"]]:
            raise InputError(
                f"gear model: trained on {odd[0]!r}, which is no gear feature; they are {', '.join(FEATURES['road'])}"
            )
        if missing := [g for g in range(1, box.gears + 1) if g not in known]:
            raise InputError(
                f"gear model: gear {missing[0]} of the sheet's {box.gears} was missing from training, which had "
                f"{', '.join(map(str, known))}; train on a log of a gearbox that has it"
            )
        return Surrogate(trees, box, tuple(known[g] for g in range(1, box.gears + 1)))

    def probabilities(self, segments: Segments, torque_nm: Array) -> Float[Array, "row gear"]:
        """How likely each gear of the box is, the row by itself. `torque_nm`: see `requested_torque`."""
        p = self.trees.probabilities(features(self.trees.features, self.box, segments, torque_nm))
        p = p[:, jnp.asarray(self.column)].astype(jnp.asarray(segments.duration_s).dtype)
        return p / jnp.sum(p, axis=1, keepdims=True)

    def __call__(self, vehicle: Vehicle, segments: Segments, *, soft: bool = True) -> Segments:
        """The rows with their gears: how likely each is, or (`soft=False`) the likeliest. All within one jit if asked."""
        return in_gears(segments, self.probabilities(segments, requested_torque(vehicle, segments)), soft=soft)


def in_gears(segments: Segments, probability: Float[Array, "row gear"], *, soft: bool) -> Segments:
    """The rows with `GEAR_PROBABILITY`, or with `gear`, the likeliest."""
    if soft:
        return segments.with_channels(**{GEAR_PROBABILITY: probability})
    gear = 1.0 + jnp.argmax(probability, axis=1).astype(probability.dtype)
    return segments.without(GEAR_PROBABILITY).with_channels(gear=gear)


def filtered(
    probability: Float[Array, "row gear"], trip: Any, *, change: Float[Array, "gear gear"], share: Float[Array, " gear"]
) -> Float[Array, "row gear"]:
    """How likely each gear is, given the row and those before it in the trip: a hidden Markov filter.

    The chain's step is `change` [from, to], what a row says is its classifier's p(g)/`share`(g) (Bourlard and Morgan,
    Connectionist Speech Recognition: scaled likelihoods); both are counted on training trips (`markov`).
    """
    trip = jnp.asarray(trip)
    fresh = jnp.concatenate([jnp.ones(1, bool), trip[1:] != trip[:-1]])
    said = probability / share[None, :]

    def step(before: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        seen, first = row
        p = jnp.where(first, share, before @ change) * seen
        p = p / jnp.sum(p)
        return p, p

    return jax.lax.scan(step, share, (said, fresh))[1]


def markov(gear: np.ndarray, trip: np.ndarray, gears: int) -> tuple[np.ndarray, np.ndarray]:
    """`change` and `share` of `filtered`, counted over trips; half a count is added to each, so that none is 0."""
    at = np.asarray(gear).astype(int) - 1
    same = np.flatnonzero(np.diff(trip) == 0)
    change = np.full((gears, gears), 0.5)
    np.add.at(change, (at[same], at[same + 1]), 1.0)
    share = np.bincount(at, minlength=gears)[:gears] + 0.5
    return change / change.sum(axis=1, keepdims=True), share / share.sum()
