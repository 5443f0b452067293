"""Energy by cause and trip through the kernel, at the estimates and at draws of the coefficients.

**Convention** (`Vehicle.breakdown`). A force counts at the wheel: rolling resistance is m·g·c_rr·v there. The loss of
driveline and machine is the power after the stage minus the power before it, for all forces together. A load or a loss
behind them counts as what it adds at its place in the chain. The correction of an instrument counts as the difference
that it makes. So losses that multiply are shared out by differences along the chain, and the causes add up to the
predicted energy exactly.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.energy.fitted import Fitted
from hdev_jax.inference import Shapes, chunks_of_fit, insert, padded
from hdev_jax.physics import DECLARED, LIBRARY, Vehicle
from hdev_jax.physics.effect import STAGES, Effect
from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling
from hdev_jax.physics.tyres import RollingLinear
from hdev_jax.segments import Segments, trip_slices

__all__ = ["ByCause", "Change", "by_cause", "is_load", "place_of", "same"]

NOTHING_KWH = 1e-9  # rounding of a loss that is none
Change = Callable[[Vehicle, Segments], tuple[Vehicle, Segments]]
_FIRST = (*(c.id for c in (Rolling, RollingLinear, Aero, Grade, Inertia)), "traction")  # then the chain's order


@dataclass(frozen=True)
class ByCause:
    """Energy of each cause in each trip [kWh]: `value` at the estimates, `drawn` at draws of the coefficients."""

    causes: tuple[str, ...]
    value: Float[np.ndarray, "trip cause"]
    drawn: Float[np.ndarray, "draw trip cause"]

    def minus(self, other: "ByCause") -> "ByCause":
        """The difference, draw by draw; a cause that one of them lacks counts as 0 there."""
        causes = tuple(dict.fromkeys((*self.causes, *other.causes)))
        a, b = self.over(causes), other.over(causes)
        return ByCause(causes, a.value - b.value, a.drawn - b.drawn)

    def over(self, causes: tuple[str, ...]) -> "ByCause":
        """The same with these causes, in this order."""

        def column(x: np.ndarray, c: str) -> np.ndarray:
            return x[..., self.causes.index(c)] if c in self.causes else np.zeros(x.shape[:-1])

        arrays = (np.stack([column(x, c) for c in causes], axis=-1) for x in (self.value, self.drawn))
        return ByCause(causes, *arrays)

    def split(self, cause: str, parts: "ByCause", rest: str) -> "ByCause":
        """`cause` told in `parts`, and what they leave of it as the cause `rest`; the sum stays as it is."""
        at = self.causes.index(cause)
        there = np.max(np.abs(parts.drawn), axis=(0, 1)) > NOTHING_KWH
        names = tuple(c for c, x in zip(parts.causes, there, strict=True) if x and c not in self.causes)
        parts = parts.over(names)
        many = len(self.drawn), *parts.drawn.shape[1:]  # a vehicle that is known has but one draw
        arrays = []
        for whole, part in ((self.value, parts.value), (self.drawn, np.resize(parts.drawn, many))):
            left = whole[..., at] - part.sum(axis=-1)
            kept = whole[..., :at], part, left[..., None], whole[..., at + 1 :]
            arrays.append(np.concatenate(kept, axis=-1))
        return ByCause((*self.causes[:at], *names, rest, *self.causes[at + 1 :]), *arrays)

    def grouped(self, member: Any) -> "ByCause":
        """Sums over groups of trips; `member` [group, trip], a sparse array of SciPy, has each trip's weight there."""
        draws, trips, causes = self.drawn.shape
        drawn = member @ np.moveaxis(self.drawn, 1, 0).reshape(trips, draws * causes)
        return ByCause(self.causes, member @ self.value, np.moveaxis(drawn.reshape(-1, draws, causes), 0, 1))


def same(vehicle: Vehicle, segments: Segments) -> tuple[Vehicle, Segments]:
    """No change."""
    return vehicle, segments


@eqx.filter_jit
def _sums(
    vehicle: Vehicle, structure: Any, thetas: Array, segments: Segments, ids: Array, trips: int, change: Change
) -> dict[str, Array]:
    def one(theta: Array) -> dict[str, Array]:
        car, rows = change(insert(vehicle, structure, theta), segments)
        return {k: jax.ops.segment_sum(p, ids, trips) / 1e3 for k, p in car.breakdown(rows).items()}

    return jax.lax.map(one, thetas)


def by_cause(fitted: Fitted, thetas: Float[np.ndarray, "draw free"], change: Change = same) -> ByCause:
    """Energy by cause and trip; `thetas` as `Fitted.draws` gives them, the estimates first.

    **Arguments:** `change` makes another vehicle or other rows of these, traceable. Padding is a trip of its own and
    is left out.
    """
    problem = fitted.problem
    segments = problem.segments
    slices = list(trip_slices(np.asarray(segments.trip)))
    rows = padded(segments, problem.measured)
    shapes = Shapes(rows.rows, max(s.stop - s.start for _, s in slices))
    found: dict[str, np.ndarray] = {}
    names = len(problem.log.trip_names)
    for chunk in chunks_of_fit(rows, shapes):
        ids = np.full(len(chunk.segments), names)
        ids[: chunk.rows] = problem.log.trip[chunk.at]
        sums = _sums(
            fitted.vehicle, problem.table.structure, jnp.asarray(thetas), chunk.segments, jnp.asarray(ids), names + 1,
            change,
        )  # fmt: skip
        for k, x in sums.items():
            found[k] = found.get(k, 0.0) + np.asarray(x)[:, :names]
    causes = tuple(sorted(found, key=_place))
    whole = np.stack([found[k] for k in causes], axis=-1)
    return ByCause(causes, whole[0], whole[1:] if len(whole) > 1 else whole)


def _effect(cause: str) -> type[Effect] | None:
    return {c.id: c for c in (*LIBRARY.values(), *DECLARED)}.get(cause)


def _place(cause: str) -> tuple[int, int, str]:
    if cause in _FIRST:
        return 0, _FIRST.index(cause), cause
    effect = _effect(cause)
    stage = "driveline" if cause == "driveline" else "machine" if cause == "machine" else "battery"
    stage = effect.stage if effect else stage
    return 1 + STAGES.index(stage), 0 if effect is None else 1, cause


def is_load(cause: str) -> bool:
    """Whether a cause is a consumer that draws whatever the drive does."""
    effect = _effect(cause)
    return effect is not None and effect.__module__.rpartition(".")[2] in ("loads", "states")


def place_of(cause: str) -> Literal["load", "loss", "wheel"]:
    """Where a cause takes its energy: a load, a loss between battery and wheels, or a force at the wheels.

    Instruments, and an effect that is not in the library, count at the wheels.
    """
    if is_load(cause):
        return "load"
    effect = _effect(cause)
    stage = cause if effect is None else effect.stage
    return "loss" if stage in ("driveline", "machine", "battery") else "wheel"
