"""What an effect is: one small class at one stage of the vehicle, its equation for one row, and its parameters."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, Field
from typing import Any, ClassVar, Literal, Protocol, get_origin, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.physics.parameter import Parameter, as_array
from hdev_jax.segments import Segments

__all__ = [
    "STAGES",
    "Car",
    "Effect",
    "GoesWith",
    "Grouped",
    "Names",
    "Parameters",
    "Point",
    "Real",
    "Row",
    "Signal",
    "Stage",
    "resolve",
]

Stage = Literal["sensors", "road", "driveline", "machine", "battery"]
STAGES: tuple[Stage, ...] = ("sensors", "road", "driveline", "machine", "battery")
GoesWith = Literal["", "weight", "air"]
Names = tuple[str, ...]
Parameters = tuple[Parameter, ...]
Real = Float[Array, ""]
Row = Segments  # of one row: its columns are scalars
Signal = Float[Array, " row"]  # one value for each row
HOOKS = ("derive", "across", "sense", "force", "drive", "power", "observe")  # methods of an effect, as they are called


class Point(eqx.Module):
    """The operating point of one row on its way from the wheel to the battery."""

    force_n: Any  # at the wheels [N]; after the driveline its equivalent there
    power_w: Any  # at the output of the stages passed so far [W]
    torque_nm: Any  # at the motor shaft, measured or from the force
    speed_radps: Any  # of the motor, measured or from the speed


class Grouped(eqx.Module):
    """A coefficient with one value for each vehicle, trip, gear or kind of surface; a row's id picks its value."""

    values: Float[Array, "*row group"] = eqx.field(converter=as_array)
    by: str = eqx.field(static=True)

    def at(self, row: Row) -> Real:
        """The value that holds for this row; ids below 0 take the first, ids past the end the last."""
        key = getattr(row, self.by) if self.by in ("vehicle", "trip") else row.channels[self.by]
        return self.values[jnp.clip(jnp.asarray(key).astype(int), 0, self.values.shape[0] - 1)]


def resolve(tree: Any, row: Row) -> Any:
    """The same tree with each `Grouped` coefficient replaced by its value for this row."""
    is_grouped: Callable[[Any], bool] = lambda x: isinstance(x, Grouped)  # noqa: E731
    return jax.tree.map(lambda x: x.at(row) if is_grouped(x) else x, tree, is_leaf=is_grouped)


def _numbers(x: Any) -> np.ndarray:
    """One number, or one of each group."""
    return np.atleast_1d(np.asarray(x.values if isinstance(x, Grouped) else x, dtype=float))


def _is_class_variable(annotation: Any) -> bool:
    """Also where annotations are kept as text."""
    if isinstance(annotation, str):
        return annotation.removeprefix("typing.").startswith("ClassVar")
    return annotation is ClassVar or get_origin(annotation) is ClassVar


@runtime_checkable
class Ratios(Protocol):
    """The part of the driveline that effects use."""

    def ratio_radpm(self, row: Row) -> Any:
        """Motor speed over vehicle speed [rad/m]."""
        ...


@runtime_checkable
class Car(Protocol):
    """The part of their vehicle that effects use, with each `Grouped` coefficient replaced by its value for the row."""

    @property
    def effects(self) -> "tuple[Effect, ...]":
        """All of them, in the order of the chain."""
        ...

    @property
    def driveline(self) -> Ratios:
        """For the ratio between motor and road."""
        ...

    def has(self, effect_id: str) -> bool:
        """Whether the vehicle has this effect; it may be there at its null."""
        ...

    def effect(self, effect_id: str) -> Any:
        """The effect of that id."""
        ...

    def mass(self, row: Row) -> Any:
        """Total mass [kg]."""
        ...

    def rolling(self) -> Any:
        """c_rr of the declared rolling resistance."""
        ...

    def drag(self, row: Row) -> Any:
        """½ρ·C_d·A of the declared drag [N/(m/s)²]."""
        ...

    def voltage(self, row: Row) -> Any:
        """Voltage of the battery [V]."""
        ...


class Effect(eqx.Module):
    """One named cause of consumption. A subclass overrides the method of its stage and no other.

    **Methods for one row:** `force`, `drive` and `power` return what the effect *adds* (N, N, W); it must be zero while
    every size is at its null value, whatever its shapes. `sense` returns the row's measurements, corrected.

    **Methods across the rows of a trip:** `derive` adds channels of its own, `across` corrects measurements, `observe`
    changes the predicted column. All must be differentiable in the effect's parameters.

    **Class attributes:** `id`, `label` (its name in a report), `stage`, `equation`, `source`. `needs`: the channels it
    reads; names joined by `|` are alternatives. `mistaken_for`: ids of effects that look alike; `separated_by`: the
    drive that tells them apart. `goes_with`: what its force is proportional to (`weight` or `air`).
    """

    id: ClassVar[str]
    label: ClassVar[str] = ""
    stage: ClassVar[Stage]
    equation: ClassVar[str]
    source: ClassVar[str] = ""
    needs: ClassVar[Names] = ()
    lacks: ClassVar[Names] = ()  # channels whose presence makes the effect pointless
    instead: ClassVar[str] = ""  # why it does, in a phrase; default: the log has the channel itself
    entries: ClassVar[Names] = ("road", "wheel", "shaft")  # where the chain may be entered for it to act
    parameters: ClassVar[Parameters] = ()
    ordered: ClassVar[tuple[tuple[str, str], ...]] = ()  # pairs of parameters of which the first is the lower
    variants: ClassVar[tuple[Names, ...]] = ()  # sets of sizes tried together; default: all of them
    derives: ClassVar[Names] = ()  # the channels that `derive` adds where rows do not have them
    mistaken_for: ClassVar[Names] = ()
    separated_by: ClassVar[str] = ""
    order: ClassVar[int] = 0  # limits come after what they limit
    of_battery: ClassVar[bool] = False  # says nothing of a force or a torque
    goes_with: ClassVar[GoesWith] = ""
    same_as: ClassVar[Names] = ()  # declared coefficients that it is another name of, where a sheet estimates them
    of_efficiency: ClassVar[bool] = False  # every drive has it, where a sheet declares one efficiency for all of it
    instrument: ClassVar[bool] = False  # a fault of a reading: said only where no cause in the vehicle does as well
    between_trips: ClassVar[bool] = False  # trips are compared with one another: it is known by the fewer of them
    declared: ClassVar[Mapping[str, str]] = {}  # fields of a declared term with their keys in a sheet
    searched: ClassVar[str] = ""  # where it is looked for, if its columns are not known before it is found

    def __init_subclass__(cls, **options: Any) -> None:
        """Every field that is declared without saying more holds a number (see `as_array`)."""
        super().__init_subclass__(**options)
        for name, kind in inspect.get_annotations(cls).items():
            default = cls.__dict__.get(name, MISSING)
            if not _is_class_variable(kind) and not isinstance(default, Field):
                given: dict[str, Any] = {} if default is MISSING else {"default": default}
                setattr(cls, name, eqx.field(converter=as_array, **given))

    @classmethod
    def reads(cls) -> frozenset[str]:
        """Every channel that the effect may read, also those that its sizes are grouped by."""
        return frozenset(n for need in cls.needs for n in need.split("|")) | {p.by for p in cls.parameters if p.by}

    @classmethod
    def implausible(cls, values: Mapping[str, Any]) -> str:
        """Why these values make no sense, in one phrase; empty where they do.

        **Arguments:** `values`: numbers by name, or arrays with one number for each group. A value that is missing,
        `None` or NaN is not judged. The null value of a size or a switch is plausible: the effect is absent.

        **Raises:** `KeyError` for a name that is not one of its parameters.
        """
        by_name = {p.name: p for p in cls.parameters}
        given = {k: _numbers(v) for k, v in values.items() if v is not None}
        for name, found in given.items():
            p = by_name[name]
            out = found[((found < p.lower) | (found > p.upper)) & ~(p.has_column & (found == p.null))]
            if len(out):
                return f"{name} is {out[0]:.4g} {p.unit}, outside of {p.lower:g} to {p.upper:g}"
        for low, high in cls.ordered:
            if low in given and high in given and np.any(given[low] >= given[high]):
                return f"{low} is {given[low].max():.4g} {by_name[low].unit}, not below {high}, {given[high].min():.4g}"
        return ""

    def derive(self, segments: Segments) -> Segments:
        """The same measurements with the channels that this effect computes by trip (distance since the start, …)."""
        return segments

    def across(self, segments: Segments) -> Segments:
        """The measurements as they should have been by this effect, trip by trip."""
        return segments

    def sense(self, row: Row, car: Car) -> Row:
        """One row's measurements, corrected."""
        return row

    def force(self, row: Row, car: Car) -> Real | float:
        """Force that this effect adds at the wheels [N]."""
        return 0.0

    def split(self, row: Row, car: Car) -> tuple[Real | float, Real | float]:
        """The parts of its force that are proportional to the weight and to the air's drag [N]."""
        if not self.goes_with:
            return 0.0, 0.0
        force = self.force(row, car)
        return (force, 0.0) if self.goes_with == "weight" else (0.0, force)

    def drive(self, row: Row, car: Car, point: Point) -> Real | float:
        """Loss in the driveline as a force at the wheel [N]."""
        return 0.0

    def power(self, row: Row, car: Car, point: Point) -> Real | float:
        """Power that this effect adds at the machine or the battery [W]."""
        return 0.0

    def observe(self, column: Signal, segments: Segments) -> Signal:
        """The predicted column as the instrument would show it, by trip."""
        return column

    @classmethod
    def acts_across_rows(cls, known: Iterable[str] = ()) -> bool:
        """Whether it needs other rows of the trip too, given that the channels `known` are there."""
        derives = cls.overrides("derive") and not (cls.derives and {*cls.derives} <= {*known})
        return derives or cls.overrides("across") or cls.overrides("observe")

    @classmethod
    def alone(cls, hook: str) -> bool:
        """Whether it overrides this method and no other."""
        return [h for h in HOOKS if cls.overrides(h)] == [hook]

    @classmethod
    def overrides(cls, hook: str) -> bool:
        """Whether this class overrides a method; the kernel calls only those that do something."""
        return getattr(cls, hook) is not getattr(Effect, hook)
