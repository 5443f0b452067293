"""What an effect is: one small class at one stage of the vehicle, its equation for one row, and its parameters."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdev_jax.segments import Segments

if TYPE_CHECKING:
    from hdev_jax.physics.vehicle import Vehicle

__all__ = ["KINDS", "STAGES", "Effect", "Grouped", "Parameter", "Point", "Real", "Stage", "resolve"]

Stage = Literal["sensors", "road", "driveline", "machine", "battery"]
STAGES: tuple[Stage, ...] = ("sensors", "road", "driveline", "machine", "battery")
Kind = Literal["size", "shape", "limit", "choice"]
KINDS: tuple[Kind, ...] = get_args(Kind)
Real = Float[Array, ""]


@dataclass(frozen=True)
class Parameter:
    """A number of an effect: its name, unit, null value and what a plausible one looks like.

    `kind` says how it acts at the null: a `size` has a derivative there (the column is one `jvp`); a `shape` (a time
    constant, a threshold) matters only once a size is not null and is tried on `grid`; a `limit` (a switch) has zero
    derivative at the null, so its column is a difference for each value of `grid`; a `choice` is a shape that is only
    ever one of its grid.

    `lower` and `upper` bound the plausible range (a drag cannot help); `scale` is a typical size, for conditioning and
    for the weak prior of a found effect. `least` is the smallest size worth naming.
    """

    name: str
    unit: str
    null: float
    scale: float
    lower: float = -float("inf")
    upper: float = float("inf")
    kind: Kind = "size"
    grid: tuple[float, ...] = ()
    least: float = 0.0
    by: Literal["", "gear", "road_surface"] = ""
    whole: bool = False  # sought in the commonest group too (nothing declared stands for it), and without groups in all
    smooth: bool = False  # a limit whose difference grows about in proportion: a fraction of a grid step is as good
    of: str = ""  # a shape's: the only size that it acts on
    in_rows: bool = False  # `grid` and `scale` count rows of the log; multiplied by its median duration


class Point(eqx.Module):
    """The operating point of one row on its way from the wheel to the battery."""

    force_n: Any  # at the wheels [N]; after the driveline its equivalent there
    power_w: Any  # at the output of the stages passed so far [W]
    torque_nm: Any  # at the motor shaft, measured or from the force
    speed_radps: Any  # of the motor, measured or from the speed


class Grouped(eqx.Module):
    """A coefficient with one value for each vehicle, trip, gear or kind of surface, looked up by the row's id."""

    values: Float[Array, "*row group"]
    by: str = eqx.field(static=True)

    def at(self, row: Segments) -> Real:
        """The value that holds for this row; ids below 0 take the first, ids past the end the last."""
        key = getattr(row, self.by) if self.by in ("vehicle", "trip") else row.channels[self.by]
        return self.values[jnp.clip(jnp.asarray(key).astype(int), 0, self.values.shape[0] - 1)]


def resolve(tree: Any, row: Segments) -> Any:
    """The same tree with each `Grouped` coefficient replaced by its value for this row."""
    is_grouped: Callable[[Any], bool] = lambda x: isinstance(x, Grouped)  # noqa: E731
    return jax.tree.map(lambda x: x.at(row) if is_grouped(x) else x, tree, is_leaf=is_grouped)


class Effect(eqx.Module):
    """One named cause of consumption. A subclass overrides the hook of its stage and no other.

    `force`, `drive` and `power` return what the effect *adds* for one row (N, N, W) and must be zero when every size
    is at its null value. `sense` returns corrected measurements of one row. What acts across rows overrides `derive`
    (channels of its own), `across` (corrected measurements) or `observe` (the predicted column), all by trip and
    differentiable in their parameters.

    Class attributes: `id` as in the contract, `stage`, `equation`, `source`; `needs`, the channels it reads, each an
    alternative of names joined by `|`; `mistaken_for` and `separated_by`, ids and the drive that tells them apart.
    """

    id: ClassVar[str]
    stage: ClassVar[Stage]
    equation: ClassVar[str]
    source: ClassVar[str] = ""
    needs: ClassVar[tuple[str, ...]] = ()
    lacks: ClassVar[tuple[str, ...]] = ()  # channels whose presence makes the effect pointless
    entries: ClassVar[tuple[str, ...]] = ("road", "wheel", "shaft")  # where the chain may be entered for it to act
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    variants: ClassVar[tuple[tuple[str, ...], ...]] = ()  # sets of sizes tried together; default: all of them
    mistaken_for: ClassVar[tuple[str, ...]] = ()
    separated_by: ClassVar[str] = ""
    order: ClassVar[int] = 0  # limits come after what they limit
    searched: ClassVar[str] = ""  # where it is looked for, if its columns are not known before it is found

    def derive(self, segments: Segments) -> Segments:
        """The same measurements with the channels that this effect computes by trip (distance since the start, …)."""
        return segments

    def across(self, segments: Segments) -> Segments:
        """Measurements as this effect says they should have been, by trip."""
        return segments

    def sense(self, row: Segments, car: "Vehicle") -> Segments:
        """One row's measurements, corrected."""
        return row

    def force(self, row: Segments, car: "Vehicle") -> Real | float:
        """Force that the road asks for besides [N]."""
        return 0.0

    def drive(self, row: Segments, car: "Vehicle", point: Point) -> Real | float:
        """Loss in the driveline as a force at the wheel [N]."""
        return 0.0

    def power(self, row: Segments, car: "Vehicle", point: Point) -> Real | float:
        """Power besides, at the machine or the battery [W]."""
        return 0.0

    def observe(self, column: Float[Array, " row"], segments: Segments) -> Float[Array, " row"]:
        """The predicted column as the instrument would show it, by trip."""
        return column

    def overrides(self, hook: str) -> bool:
        """Whether this class has a hook of its own, so that the kernel calls only what does something."""
        return getattr(type(self), hook) is not getattr(Effect, hook)
