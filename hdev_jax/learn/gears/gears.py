"""The gear as a surrogate: features of a row, trees that predict the gear, and the channel that the kernel reads.

Paper 1, section 3.1: speed, requested torque and mass. What the sheet knows makes rows of different vehicles alike: the
motor speed that each gear would give and the power that is requested, over rated, and how many gears there are. Two
ways: the trees predict the gear's number; or by how many gears it is away from the one in which the motor would
turn at its rated speed (`relative`), so that what is learned of one gear holds for all, in gearboxes never seen too.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.errors import InputError
from hdev_jax.learn.trees.trees import Trees
from hdev_jax.physics import GEAR_PROBABILITY, Vehicle
from hdev_jax.segments import Column, Segments

__all__ = [
    "FEATURES",
    "MOST_GEARS",
    "Gearbox",
    "Surrogate",
    "features",
    "filtered",
    "in_gears",
    "markov",
    "requested_torque",
]

MOST_GEARS = 12
_PAPER = ("speed_mps", "requested_torque_nm", "mass_kg")
_SHEET = ("gears", "power_over_rated", *(f"motor_speed_over_rated_{g}" for g in range(1, MOST_GEARS + 1)))
PLACE = "place_after_reference"
_RELATIVE = (PLACE, "step_below", "step_above", "reference_gear", "gears", "power_over_rated", "grade_rad")
# By what is known: the paper's three; with the vehicle's sheet; with the sheet and the slope of the road, where the
# trees predict the distance from the reference gear.
FEATURES: dict[str, tuple[str, ...]] = {"paper": _PAPER, "sheet": (*_PAPER, *_SHEET), "relative": (*_PAPER, *_RELATIVE)}
EVERY: tuple[str, ...] = tuple(dict.fromkeys(n for names in FEATURES.values() for n in names))


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

    def reference(self, speed_mps: Array) -> tuple[Array, Array]:
        """The highest gear in which the motor would turn at its rated speed or faster, at least the first; and the log
        of how much faster [both by row]."""
        turns = jnp.log(self.ratio_radpm / self.rated_radps)
        log_speed = jnp.log(jnp.maximum(speed_mps, 0.1))[:, None] + turns[None, :]
        gear = jnp.clip(jnp.sum(log_speed >= 0, axis=-1), 1, self.gears)
        return gear, jnp.take_along_axis(log_speed, gear[:, None] - 1, axis=-1)[:, 0]


def requested_torque(vehicle: Vehicle, segments: Segments) -> Float[Array, " row"]:
    """Torque asked for at the wheels [Nm]: the log's, else the kernel's force times the radius of the wheel."""
    if segments.has("requested_torque_nm"):
        return jnp.asarray(segments.channels["requested_torque_nm"])
    return vehicle.force(segments) * vehicle.driveline.wheel_radius_m


def features(names: tuple[str, ...], box: Gearbox, segments: Segments, torque_nm: Any) -> Float[Array, "row feature"]:
    """Columns of `FEATURES` [row, feature], float32. A gear that the box lacks turns the motor at 0.

    **Raises:** `ValueError` for an unknown name; `KeyError` for a channel that the log lacks.
    """
    speed = jnp.asarray(segments.speed_mps)
    reference, place = box.reference(speed)
    steps = jnp.log(box.ratio_radpm[:-1] / box.ratio_radpm[1:]) if box.gears > 1 else jnp.zeros(1)
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
            case _ if name == PLACE:
                x = place
            case _ if name == "step_below":
                x = steps[jnp.clip(reference - 2, 0, steps.shape[0] - 1)]
            case _ if name == "step_above":
                x = steps[jnp.clip(reference - 1, 0, steps.shape[0] - 1)]
            case _ if name == "reference_gear":
                x = reference
            case _ if name in ("mass_kg", "grade_rad"):
                x = jnp.asarray(segments.channels[name])
            case _:
                raise ValueError(f"no gear feature {name!r}; they are {', '.join(EVERY)}")
        columns.append(x.astype(jnp.float32))
    return jnp.stack(columns, axis=1)


class Surrogate(eqx.Module):
    """Trees that predict the gear of a row of one vehicle. `of` a model that was trained on several gearboxes.

    Trees with the feature `PLACE` predict the distance from the reference gear, others the gear.
    """

    trees: Trees
    box: Gearbox

    @staticmethod
    def of(trees: Trees, box: Gearbox) -> "Surrogate":
        """The surrogate for this gearbox.

        **Raises:** `InputError` for features that are not of `EVERY`, and where the box has a gear that was missing
        from training.
        """
        if odd := [n for n in trees.features if n not in EVERY]:
            raise InputError(
                f"gear model: trained on {odd[0]!r}, which is no gear feature; they are {', '.join(EVERY)}"
            )
        known = [int(c) for c in trees.classes]
        if PLACE not in trees.features and (missing := sorted({*range(1, box.gears + 1)} - {*known})):
            raise InputError(
                f"gear model: gear {missing[0]} of the sheet's {box.gears} was missing from training, which had "
                f"{', '.join(map(str, known))}; train on a log of a gearbox that has it"
            )
        return Surrogate(trees, box)

    def probabilities(self, segments: Segments, torque_nm: Array) -> Float[Array, "row gear"]:
        """How likely each gear of the box is, the row by itself. `torque_nm`: see `requested_torque`."""
        p = self.trees.probabilities(features(self.trees.features, self.box, segments, torque_nm))
        reference = None
        if PLACE in self.trees.features:
            reference, _ = self.box.reference(jnp.asarray(segments.speed_mps))
        # added up to 1 in the kernel's own precision
        p = p.astype(jnp.asarray(segments.duration_s).dtype)
        return absolute(p, self.trees.classes, reference, self.box.gears)

    def __call__(self, vehicle: Vehicle, segments: Segments, *, soft: bool = True) -> Segments:
        """The rows with their gears: how likely each is, or (`soft=False`) the likeliest. May be all within one jit."""
        return in_gears(segments, self.probabilities(segments, requested_torque(vehicle, segments)), soft=soft)


def absolute(probability: Column, classes: tuple[float, ...], reference: Any, gears: int) -> Float[Array, "row gear"]:
    """Probabilities of the box's gears: of the classes that are gears of it, or (`reference` [row]) of distances from
    the reference gear, those beyond the ends counting for the last gear there is."""
    told = jnp.asarray(classes, jnp.int32)[None, :]
    if reference is not None:
        told = jnp.clip(told + reference[:, None], 1, gears)
    # one gear after the other: the sum over classes stays in registers
    columns = [jnp.sum(jnp.where(told == g, jnp.asarray(probability), 0), axis=1) for g in range(1, gears + 1)]
    p = jnp.stack(columns, axis=1)
    return p / jnp.maximum(jnp.sum(p, axis=1, keepdims=True), jnp.finfo(p.dtype).tiny)


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


def chained(given: Float[Array, "row before gear"], trip: Any) -> Float[Array, "row gear"]:
    """How likely each gear is after all rows so far, of a classifier that was trained with the previous gear.

    `given` is what it says for each gear that may have been before: p_k(g) = Σ p_k(g | before)·p_{k−1}(before), and any
    gear is as likely before a trip.
    """
    trip = jnp.asarray(trip)
    fresh = jnp.concatenate([jnp.ones(1, bool), trip[1:] != trip[:-1]])
    start = jnp.full(given.shape[1], 1.0 / given.shape[1], given.dtype)

    def step(before: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        seen, first = row
        p = jnp.where(first, start, before) @ seen
        return p, p

    return jax.lax.scan(step, start, (jnp.asarray(given), fresh))[1]


def markov(gear: np.ndarray, trip: np.ndarray, gears: int) -> tuple[np.ndarray, np.ndarray]:
    """`change` and `share` of `filtered`, counted over trips; half a count is added to each, so that none is 0."""
    at = np.asarray(gear).astype(int) - 1
    same = np.flatnonzero(np.diff(trip) == 0)
    change = np.full((gears, gears), 0.5)
    np.add.at(change, (at[same], at[same + 1]), 1.0)
    share = np.bincount(at, minlength=gears)[:gears] + 0.5
    return change / change.sum(axis=1, keepdims=True), share / share.sum()
