"""The vehicle: a sum of effects along one chain, road → driveline → machine → battery, entered where it is measured."""

from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdev_jax.physics.driveline import Driveline, EfficiencyMap
from hdev_jax.physics.effect import STAGES, Effect, Point, Real, resolve
from hdev_jax.physics.machine import Machine, switch
from hdev_jax.physics.parameter import as_array
from hdev_jax.physics.road import weight_on_road
from hdev_jax.segments import ACCEL_OF_WAY, ACCEL_SD, GRADE_SD, READING_ERRORS, SPREAD, Segments
from hdev_jax.targets import Target, target_of
from hdev_jax.units import AIR_DENSITY_KGPM3, GRAVITY_MPS2, J_PER_WH

__all__ = ["Entry", "Vehicle", "coefficients_that_hold"]

_SLOW_MPS = 0.1  # below, the drag area would be a ratio of next to nothing
Entry = Literal["road", "wheel", "shaft"]


class _Chain(NamedTuple):
    """What one row came to: what each effect added [W], in order, and where it ended."""

    added_w: dict[str, Real]
    wheel_n: Real  # force at the wheels [N]
    drive_n: Real  # the same behind the driveline, at the wheel [N]
    point: Point


class Vehicle(eqx.Module):
    """A sum of effects. Nothing is changed in place: `plus` and `minus` return new vehicles.

    **Arguments:**

    - `effects`: in any order; they are kept by stage, order and id, so that vehicles with the same effects share
      compiled programs.
    - `mass_kg`, `nominal_voltage_v`: used where the log has no `mass_kg` or no `voltage_v`.
    - `driveline`, `machine`: the efficiencies of the chain; by default no losses. A driveline's efficiency covers the
      chain from the wheel to the battery unless its `covers_machine` is False.
    - `entry`: the measured quantity where the chain begins: `road` (nothing is measured), `wheel` (`traction_force_n`)
      or `shaft` (`motor_torque_nm`; without a logged motor speed, the wheels' speed times the ratio).
    """

    effects: tuple[Effect, ...]
    mass_kg: Real = eqx.field(converter=as_array)
    nominal_voltage_v: Real | None = eqx.field(converter=as_array)
    driveline: Driveline
    machine: Machine
    entry: Entry = eqx.field(static=True)

    def __init__(
        self,
        effects: Iterable[Effect],
        *,
        mass_kg: Any,
        driveline: Driveline | None = None,
        machine: Machine | None = None,
        entry: Entry = "road",
        nominal_voltage_v: Any = None,
    ):
        effects = tuple(effects)
        ids = [e.id for e in effects]
        if len(set(ids)) < len(ids):
            raise ValueError(f"each effect once in a vehicle, found {ids}; use minus() before plus() to replace one")
        self.effects = tuple(sorted(effects, key=_place))
        self.mass_kg = mass_kg
        self.driveline = Driveline() if driveline is None else driveline
        self.machine = Machine() if machine is None else machine
        self.entry = entry
        self.nominal_voltage_v = nominal_voltage_v

    # --- the sum -----------------------------------------------------------------------------------------------

    def plus(self, *effects: Effect) -> "Vehicle":
        """This vehicle with more effects. Raises `ValueError` if one is there already."""
        return self._with((*self.effects, *effects))

    def minus(self, *ids: str) -> "Vehicle":
        """This vehicle without the effects of these ids. Raises `ValueError` for one that it does not have."""
        if missing := set(ids) - {e.id for e in self.effects}:
            raise ValueError(
                f"no such effect in this vehicle: {sorted(missing)}; it has {[e.id for e in self.effects]}"
            )
        return self._with(tuple(e for e in self.effects if e.id not in ids))

    def has(self, effect_id: str) -> bool:
        """Whether the vehicle has this effect."""
        return any(e.id == effect_id for e in self.effects)

    def effect(self, effect_id: str) -> Any:
        """The effect of that id. Raises `KeyError`."""
        for e in self.effects:
            if e.id == effect_id:
                return e
        raise KeyError(effect_id)

    def _with(self, effects: tuple[Effect, ...]) -> "Vehicle":
        return Vehicle(
            effects, mass_kg=self.mass_kg, driveline=self.driveline, machine=self.machine, entry=self.entry,
            nominal_voltage_v=self.nominal_voltage_v,
        )  # fmt: skip

    # --- what effects read of the vehicle ------------------------------------------------------------------------

    def mass(self, row: Segments) -> Any:
        """Total mass [kg]: the log's, else the sheet's."""
        return row.get("mass_kg", self.mass_kg)

    def rolling(self) -> Any:
        """c_rr of the declared rolling resistance, 0 where there is none."""
        return self.effect("rolling").c_rr if self.has("rolling") else 0.0

    def drag(self, row: Segments) -> Any:
        """½ρ·C_d·A of the declared drag [N/(m/s)²], 0 where there is none; ρ is the log's, else the standard ρ₀."""
        density = row.get("air_density_kgpm3", AIR_DENSITY_KGPM3)
        return 0.5 * density * self.effect("aero").cda_m2 if self.has("aero") else 0.0

    def voltage(self, row: Segments) -> Any:
        """Voltage of the battery [V]: the log's, else the sheet's nominal one."""
        if row.has("voltage_v"):
            return row.channels["voltage_v"]
        if self.nominal_voltage_v is None:
            raise ValueError("the log has no voltage_v and the vehicle no nominal_voltage_v; one of them is expected")
        return self.nominal_voltage_v

    @property
    def one_efficiency(self) -> bool:
        """Whether one number stands for all losses from the wheel to the battery, driving and braking."""
        line = self.driveline
        whole = self.entry == "road" and line.covers_machine and line.regenerating_efficiency is None
        return whole and not isinstance(line.efficiency, EfficiencyMap)

    @property
    def stands_in(self) -> tuple[str, ...]:
        """Names of the vehicle's values that can replace a channel of the log (`nominal_voltage_v`)."""
        return () if self.nominal_voltage_v is None else ("nominal_voltage_v",)

    # --- one row ---------------------------------------------------------------------------------------------------

    def _chain(self, row: Segments) -> _Chain:
        """One row from the entry to the battery. Sensors have been applied."""
        car = resolve(self, row)
        v = jnp.asarray(row.speed_mps)
        added: dict[str, Any] = {}
        zero = jnp.zeros((), v.dtype)
        force: Any = zero
        if self.entry == "road":
            for e in car.effects:
                if e.overrides("force"):
                    with jax.named_scope(e.id):
                        f = e.force(row, car)
                    added[e.id] = f * v
                    force = force + f
        else:
            force = row.get("traction_force_n", zero) if self.entry == "wheel" else zero
            added["traction"] = force * v
        wheel = force
        ratio = car.driveline.ratio_radpm(row)
        if self.entry == "road":
            speed = row.get("motor_speed_radps", v * ratio)
            eta = car.driveline.efficiency_at(row, speed, force / ratio)
            back = car.driveline.regenerating_efficiency
            force = switch(force, eta, eta if back is None else back)
            added["driveline"] = (force - wheel) * v
            for e in car.effects:
                if e.overrides("drive"):
                    with jax.named_scope(e.id):
                        f = e.drive(row, car, Point(force, force * v, force / ratio, speed))
                    added[e.id] = f * v
                    force = force + f
        drive = force
        if self.entry == "shaft":
            torque, speed = row.channels["motor_torque_nm"], row.get("motor_speed_radps", v * ratio)
            power = torque * speed
            added["traction"] = power
        else:
            torque, speed = force / ratio, row.get("motor_speed_radps", v * ratio)
            power = force * v
        if self.entry != "road" or not car.driveline.covers_machine:
            mechanical = power
            power = switch(mechanical, car.machine.motoring_efficiency, car.machine.regenerating_efficiency)
            added["machine"] = power - mechanical
        for e in car.effects:
            if e.overrides("power"):
                with jax.named_scope(e.id):
                    p = e.power(row, car, Point(force, power, torque, speed))
                added[e.id] = p
                power = power + p
        return _Chain(added, wheel, drive, Point(force, power, torque, speed))

    def _sensed(self, row: Segments) -> Segments:
        car = resolve(self, row)
        for e in car.effects:
            if e.overrides("sense"):
                row = e.sense(row, car)
        return row

    def _rows(self, segments: Segments, of: Callable[[_Chain, Segments], Any]) -> Any:
        """`of` the chain of every row; the one `vmap` of the kernel."""
        segments = jax.tree.map(jnp.asarray, self.corrected(segments))

        def column(row: Segments) -> Any:
            return of(self._chain(self._sensed(row)), row)

        if self.entry != "road" or not any(segments.has(k) for k in (SPREAD, *READING_ERRORS)):
            return jax.vmap(column)(segments)
        # The expectation over what slope and acceleration may be, or are inside a row, by the two points that have the
        # mean and variance of their force: where power changes its sign the chain bends, which costs energy on average.
        level = jnp.zeros_like(segments.duration_s)
        sd = jnp.hypot(segments.get(GRADE_SD, level), segments.get(ACCEL_SD, level) / GRAVITY_MPS2)
        name, middle = "grade_rad", segments.get("grade_rad", level)
        if segments.has(SPREAD):  # as large as accelerations are: such a slope would lift the weight off the road
            name, middle = ACCEL_OF_WAY, segments.accel_of_way_mps2
            sd = jnp.hypot(GRAVITY_MPS2 * sd, segments.channels[SPREAD])
        sides = [jax.vmap(column)(segments.with_channels(**{name: middle + e})) for e in (sd, -sd)]
        return jax.tree.map(lambda a, b: 0.5 * (a + b), *sides)

    # --- a target in three steps: they can be compiled apart ----------------------------------------------------------

    def corrected(self, segments: Segments) -> Segments:
        """The measurements as they should have been, by the effects that act across rows, with what these derive."""
        for e in self.effects:
            segments = e.across(e.derive(segments))
        return segments

    def column(self, segments: Segments, target: str | Target) -> Float[Array, " row"]:
        """What each row comes to before an instrument shows it: battery power [W], torque [Nm] or force [N]."""
        match target_of(target).name:
            case "energy_wh" | "battery_power_kw":
                return self._rows(segments, lambda c, _: c.point.power_w)
            case "motor_torque_nm":
                held = _in_motion if self.entry == "road" else lambda _, torque: torque
                return self._rows(segments, lambda c, row: held(row, c.point.torque_nm))
            case "traction_force_n":
                return self._rows(segments, lambda c, row: _in_motion(row, c.wheel_n))

    def shown(self, column: Float[Array, " row"], segments: Segments, target: str | Target) -> Float[Array, " row"]:
        """A `column` as the instrument shows it, in the target's unit."""
        column = self._observed(column, segments)
        match target_of(target).name:
            case "energy_wh":
                return column * (jnp.asarray(segments.duration_s) / J_PER_WH)
            case "battery_power_kw":
                return column / 1000.0
            case "motor_torque_nm" | "traction_force_n":
                return column

    def _observed(self, column: Array, segments: Segments) -> Array:
        for e in self.effects:
            if e.overrides("observe"):
                column = e.observe(column, jax.tree.map(jnp.asarray, segments))
        return column

    # --- what users ask for ------------------------------------------------------------------------------------------

    def predict(self, segments: Segments, target: str | Target) -> Float[Array, " row"]:
        """The prediction of a target, in the target's unit; `target` is its name (`energy_wh`, …) or a `Target`."""
        return self.shown(self.column(segments, target), segments, target)

    def power(self, segments: Segments) -> Float[Array, " row"]:
        """Mean battery power of each row [W], positive out of the battery."""
        return self._observed(self.column(segments, "battery_power_kw"), segments)

    def energy(self, segments: Segments) -> Float[Array, " row"]:
        """Battery energy of each row [Wh]: e of paper 1, equation 5, with all effects of the vehicle."""
        return self.predict(segments, "energy_wh")

    def force(self, segments: Segments) -> Float[Array, " row"]:
        """Traction force at the wheels [N]: F_w of paper 1, equation 3; 0 at a standstill, where brakes hold.

        Entry must be `road`.
        """
        return self.predict(segments, "traction_force_n")

    def torque(self, segments: Segments) -> Float[Array, " row"]:
        """Torque at the motor shaft [Nm] (paper 2, equations 4 and 9); 0 at a standstill where the force is computed.

        Entry must be `road` or `wheel`.
        """
        return self.predict(segments, "motor_torque_nm")

    def breakdown(self, segments: Segments) -> dict[str, Float[Array, " row"]]:
        """Energy of each effect by row [Wh], by effect id. The entries add up to `energy`, but for rounding.

        Forces count at the wheel. The entries `driveline` and `machine` are the losses by their efficiencies. A sensor
        effect counts by the difference that it makes to the prediction.
        """
        hours = jnp.asarray(segments.duration_s) / J_PER_WH
        car = self._with(tuple(e for e in self.effects if not _is_sensor(e)))
        added, column = car._rows(segments, lambda c, _: (c.added_w, c.point.power_w))
        parts, before = {k: w * hours for k, w in added.items()}, column * hours
        for e in self.effects:
            if _is_sensor(e):
                car = car.plus(e)
                if not e.alone("observe"):  # which acts behind the kernel
                    column = car.column(segments, "energy_wh")
                after = car.shown(column, segments, "energy_wh")
                parts[e.id] = after - before
                before = after
        return parts


def _place(effect: Effect) -> tuple[int, int, str]:
    """Declared terms of a stage come first, as they were given."""
    return STAGES.index(effect.stage), effect.order, "" if effect.declared or not effect.parameters else effect.id


def _in_motion(row: Segments, x: Any) -> Any:
    return jnp.where(jnp.asarray(row.speed_mps) > 0, x, 0.0)


def _is_sensor(e: Effect) -> bool:
    return e.overrides("across") or e.overrides("sense") or e.overrides("observe")


def coefficients_that_hold(car: Vehicle, row: Segments) -> tuple[Real, Real]:
    """c_rr and C_d·A [m²] of one row that stand for all its forces proportional to the weight and to the air's drag.

    Rolling resistance and drag with these coefficients alone equal the sum of those effects. The channels that the
    effects derive by trip must be there. At a standstill (for C_d·A below 0.1 m/s) the declared coefficient holds.

    **Raises:** `KeyError` for a vehicle without rolling resistance or drag.
    """
    car = resolve(car, row)
    parts = [e.split(row, car) for e in car.effects]
    weight: Any = sum(w for w, _ in parts)
    air: Any = sum(a for _, a in parts)
    square = row.square_speed_m2ps2
    moves = row.distance_m > 0
    fast = moves & (square > _SLOW_MPS**2)
    pressure = 0.5 * row.get("air_density_kgpm3", AIR_DENSITY_KGPM3) * jnp.where(fast, square, 1.0)
    return (
        jnp.where(moves, weight / weight_on_road(row, car), car.effect("rolling").c_rr),
        jnp.where(fast, air / pressure, car.effect("aero").cda_m2),
    )
