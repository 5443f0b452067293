"""Loads of the vehicle that draw on the battery whatever the drive does."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from hdev_jax.physics.effect import Car, Effect, Names, Parameters, Point, Real, Row, Stage
from hdev_jax.physics.parameter import Choice, Shape, Size

__all__ = [
    "Auxiliary",
    "AuxiliaryPower",
    "CabinWarmup",
    "CoolingPower",
    "HvacPower",
    "PassengerHeat",
    "PeriodicLoad",
    "StandstillLoad",
]

STANDSTILL_MPS = 0.1
HEATING_BELOW_C, COOLING_ABOVE_C = 18.0, 22.0  # usual set points of a city bus's cabin (VDV 236)


class Auxiliary(Effect):
    """The declared auxiliary load of the sheet, `[battery] auxiliary_w`."""

    id: ClassVar[str] = "auxiliary"
    label: ClassVar[str] = "declared auxiliary load"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "P_aux"
    source: ClassVar[str] = "paper 1, section 3.2 (loads)"
    declared: ClassVar[Mapping[str, str]] = {"auxiliary_w": "battery.auxiliary_w"}
    auxiliary_w: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return self.auxiliary_w


class AuxiliaryPower(Effect):
    """A constant load in addition to the declared one."""

    id: ClassVar[str] = "auxiliary_power"
    label: ClassVar[str] = "constant auxiliary load"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "P₀"
    source: ClassVar[str] = "paper 2, section III-A (loads left out there)"
    # electric heaters of articulated buses have 40 to 60 kW
    parameters: ClassVar[Parameters] = (Size("power_w", "W", 0.0, 1000.0, 0.0, 6e4, least=50.0, constant=True),)
    mistaken_for: ClassVar[Names] = ("power_gain", "inverter_loss")
    separated_by: ClassVar[str] = "standing still with the vehicle on, and with it off"
    power_w: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return self.power_w


class HvacPower(Effect):
    """Heating below one temperature and cooling above another: k₁·max(T₁−T, 0) + k₂·max(T−T₂, 0)."""

    id: ClassVar[str] = "hvac_power"
    label: ClassVar[str] = "cabin heating and cooling"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "k₁·max(T₁−T, 0) + k₂·max(T−T₂, 0)"
    source: ClassVar[str] = "Basma et al., Energy 207 (2020) (bus cabin, steady state)"
    needs: ClassVar[Names] = ("ambient_temp_c",)
    parameters: ClassVar[Parameters] = (
        # an articulated bus loses about 1 kW/K through its skin and its doors
        Size("below_w_per_k", "W/K", 0.0, 100.0, 0.0, 3e3, least=1.0, label="below the heating limit"),
        Size("above_w_per_k", "W/K", 0.0, 100.0, 0.0, 3e3, least=1.0, label="above the cooling limit"),
        Shape(
            "heat_c", "°C", HEATING_BELOW_C, 4.0, -5.0, 26.0, grid=(10.0, 14.0, 18.0, 22.0),
            of="below_w_per_k", label="heating limit"
        ),
        Shape(
            "cool_c", "°C", COOLING_ABOVE_C, 4.0, 14.0, 34.0, grid=(18.0, 22.0, 26.0),
            of="above_w_per_k", label="cooling limit"
        ),
    )  # fmt: skip
    ordered: ClassVar[tuple[tuple[str, str], ...]] = (("heat_c", "cool_c"),)
    variants: ClassVar[tuple[Names, ...]] = (("below_w_per_k",), ("above_w_per_k",), ("below_w_per_k", "above_w_per_k"))
    mistaken_for: ClassVar[Names] = ("rolling_temperature", "air_density")
    separated_by: ClassVar[str] = "standing still on hot and cold days"
    below_w_per_k: Any
    above_w_per_k: Any
    heat_c: Any
    cool_c: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        t = row.channels["ambient_temp_c"]
        heating = self.below_w_per_k * jnp.maximum(self.heat_c - t, 0.0)
        return heating + self.above_w_per_k * jnp.maximum(t - self.cool_c, 0.0)


class PassengerHeat(Effect):
    """Warmth of the passengers: each of them saves the power h while heating, and costs it while cooling.

    The limits of heating and cooling, T₁ and T₂, are those of `hvac_power` where the vehicle has it.
    """

    id: ClassVar[str] = "passenger_heat"
    label: ClassVar[str] = "heat from passengers"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "h·N·([T > T₂] − [T < T₁])"
    source: ClassVar[str] = "Basma et al., Energy 207 (2020) (occupants in the cabin's heat balance)"
    needs: ClassVar[Names] = ("passengers", "ambient_temp_c")
    parameters: ClassVar[Parameters] = (
        Size("w_per_passenger", "W", 0.0, 50.0, 0.0, 150.0, least=1.0, label="power per passenger"),
    )
    mistaken_for: ClassVar[Names] = ("hvac_power", "mass_scale")
    separated_by: ClassVar[str] = "an hour at standstill, full and empty"
    order: ClassVar[int] = 10
    w_per_passenger: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        t = row.channels["ambient_temp_c"]
        heat_c, cool_c = HEATING_BELOW_C, COOLING_ABOVE_C
        if car.has("hvac_power"):  # a side that costs nothing has no temperature to speak of
            hvac = car.effect("hvac_power")
            heat_c = jnp.where(hvac.below_w_per_k > 0, hvac.heat_c, heat_c)
            cool_c = jnp.where(hvac.above_w_per_k > 0, hvac.cool_c, cool_c)
        # an edge of 1 K: a cabin does not change over at once, and the temperatures keep a slope
        side = jax.nn.sigmoid((t - cool_c) / 1.0) - jax.nn.sigmoid((heat_c - t) / 1.0)
        return self.w_per_passenger * row.channels["passengers"] * side


class CabinWarmup(Effect):
    """A load that dies away after the start: P·exp(−t/t₀)."""

    id: ClassVar[str] = "cabin_warmup"
    label: ClassVar[str] = "cabin warm-up"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "P·exp(−t/t₀)"
    source: ClassVar[str] = "Basma et al., Energy 207 (2020) (cabin transient)"
    parameters: ClassVar[Parameters] = (
        Size("power_w", "W", 0.0, 1000.0, 0.0, 6e4, least=100.0),
        Shape("tau_s", "s", 900.0, 600.0, 60.0, 7200.0, grid=(300.0, 900.0, 2400.0), label="time constant"),
    )
    mistaken_for: ClassVar[Names] = ("tyre_warmup",)
    separated_by: ClassVar[str] = "standing still early and late"
    power_w: Any
    tau_s: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        t = row.time_s + 0.5 * row.duration_s
        return self.power_w * jnp.exp(-t / self.tau_s)


class PeriodicLoad(Effect):
    """A load that switches on and off: P while cos(2π(t/T + φ)) > cos(πD).

    T is the period, D the share of time on, and φ the phase, which may differ from trip to trip. Where φ is unknown
    (NaN), as on a trip outside the fit, the load is its mean P·D.
    """

    id: ClassVar[str] = "periodic_load"
    label: ClassVar[str] = "periodic load"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "P·[cos 2π(t/T + φ) > cos πD], φ by trip"
    source: ClassVar[str] = "thermostat with hysteresis"
    parameters: ClassVar[Parameters] = (
        Size("power_w", "W", 0.0, 1000.0, 0.0, 6e4, least=100.0),
        Shape("period_s", "s", 900.0, 300.0, 20.0, 7200.0, grid=(600.0, 1200.0, 1500.0)),
        Shape("duty", "1", 0.5, 0.2, 0.05, 0.95, grid=(0.3, 0.5, 0.7)),
        Choice("phase", "1", float("nan"), 0.25, -1.0, 1.0),
    )
    searched: ClassVar[str] = "spectrum"
    mistaken_for: ClassVar[Names] = ("standstill_load",)
    separated_by: ClassVar[str] = "an hour at standstill"
    power_w: Any
    period_s: Any
    duty: Any
    phase: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return self.power_w * self.on(row.time_s, row.duration_s)

    def on(self, start_s: Any, duration_s: Any) -> Any:
        """Share of an interval during which the load is on; `start_s` from the trip's start [s]; arrays of any shape.

        It is the mean of the square wave over the interval, so it is continuous in period, duty and phase.
        """
        known = jnp.logical_not(jnp.isnan(self.phase))
        lag = jnp.where(known, self.phase, 0.0) + 0.5 * self.duty

        def periods_on(time_s: Any) -> Any:
            x = time_s / self.period_s + lag
            return self.duty * jnp.floor(x) + jnp.minimum(x - jnp.floor(x), self.duty)

        share = (periods_on(start_s + duration_s) - periods_on(start_s)) * self.period_s / duration_s
        return jnp.where(known, share, self.duty)


class StandstillLoad(Effect):
    """A load while the vehicle stands: P·[v = 0], all the time or only while the doors are open."""

    id: ClassVar[str] = "standstill_load"
    label: ClassVar[str] = "load at standstill"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "P·[v < 0.1 m/s]·(1 − d + d·door)"
    source: ClassVar[str] = "PTO, doors and kneeling of city buses"
    parameters: ClassVar[Parameters] = (
        Size("power_w", "W", 0.0, 1000.0, 0.0, 1e5, least=100.0),
        Choice("by_door", "1", 0.0, 1.0, 0.0, 1.0, grid=(0.0, 1.0)),
    )
    mistaken_for: ClassVar[Names] = ("auxiliary_power", "periodic_load")
    separated_by: ClassVar[str] = "parked, the load on and off"
    power_w: Any
    by_door: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        flag = 1.0 - self.by_door + self.by_door * row.get("door_open", 1.0)
        return self.power_w * jnp.where(row.speed_mps < STANDSTILL_MPS, flag, 0.0)


class CoolingPower(Effect):
    """Cooling of the battery: k·max(T_batt − T₀, 0)."""

    id: ClassVar[str] = "cooling_power"
    label: ClassVar[str] = "cooling power"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "k·max(T_batt − T₀, 0)"
    source: ClassVar[str] = "thermostat of a battery chiller"
    needs: ClassVar[Names] = ("battery_temp_c",)
    parameters: ClassVar[Parameters] = (
        # chillers of batteries have 2 to 10 kW, reached within 5 to 10 K
        Size("w_per_k", "W/K", 0.0, 100.0, 0.0, 2e3, least=1.0),
        Shape("start_c", "°C", 25.0, 4.0, 5.0, 45.0, grid=(20.0, 25.0, 30.0)),
    )
    mistaken_for: ClassVar[Names] = ("hvac_power",)
    separated_by: ClassVar[str] = "standing still after hard driving"
    w_per_k: Any
    start_c: Any

    def power(self, row: Row, car: Car, point: Point) -> Real:
        return self.w_per_k * jnp.maximum(row.channels["battery_temp_c"] - self.start_c, 0.0)
