"""Effects with a state that no channel of the log shows: a load that is on or off."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp

from hdev_jax.physics.effect import Car, Effect, Names, Parameters, Point, Real, Row, Stage
from hdev_jax.physics.loads import STANDSTILL_MPS
from hdev_jax.physics.parameter import Choice, Size

__all__ = [
    "COVARIATES",
    "KNOTS_C",
    "SWITCHING_LOADS",
    "Covariate",
    "SecondSwitchingLoad",
    "SwitchingLoad",
    "covariates_of",
    "expected_share",
    "state_channel",
]

KNOTS_C = (0.0, 10.0, 20.0, 30.0)  # ambient temperatures at which the share of time on is given
USUAL_C = 15.0  # where the log has no temperature; the shares are one number then
START_S = 600.0  # in which the start of a trip fades: cabins and batteries of buses warm up in 10 to 20 minutes
HALF = 0.5  # state of charge at which the shares are given


class Covariate(NamedTuple):
    """A quantity, beside the outside temperature, on which the share of time on may depend.

    `name`: the parameter that holds its log-odds. `value`: its value in a row. `high`, `low`: where that is highest
    and lowest, in words."""

    name: str
    value: Callable[[Any], Any]
    high: str
    low: str


COVARIATES = (
    Covariate("by_standstill", lambda row: jnp.where(row.speed_mps < STANDSTILL_MPS, 1.0, 0.0),
              "at standstill", "in motion"),
    Covariate("by_start", lambda row: jnp.exp(-row.time_s / START_S), "at the start of a trip", "later"),
    Covariate("by_soc", lambda row: row.get("soc", HALF) - HALF, "with the fullest battery", "with the emptiest"),
    Covariate("by_door", lambda row: row.get("door_open", 0.0) * 1.0, "with doors open", "with doors closed"),
)  # fmt: skip


def covariates_of(row: Any) -> Any:
    """`COVARIATES` in a row, or in all rows of segments, along the last axis; 0 where the log has no such channel."""
    like = row.speed_mps
    return jnp.stack([jnp.broadcast_to(jnp.asarray(c.value(row), like.dtype), like.shape) for c in COVARIATES], axis=-1)


def state_channel(effect_id: str) -> str:
    """The channel with the decoded state of an effect: the share of each row during which it is on."""
    return f"derived:{effect_id}"


def expected_share(temp_c: Any, shares: Any, log_odds: Any = 0.0) -> Any:
    """Share of time on at an ambient temperature [°C], linear between `KNOTS_C` and constant beyond; of any shape.

    `log_odds` of other covariates multiply the odds of being on by e^log_odds; shares of 0 and 1 stay as they are.
    """
    shares = jnp.asarray(shares)
    share = jnp.interp(jnp.asarray(temp_c, shares.dtype), jnp.asarray(KNOTS_C, shares.dtype), shares)
    odds = jnp.exp(jnp.asarray(log_odds, shares.dtype))
    return share * odds / (share * odds + 1.0 - share)


class SwitchingLoad(Effect):
    """A consumer that is on or off: P·s, with a hidden state s, 1 while it is on.

    Where measured power is there, the state is decoded from it into the channel `derived:switching_load`. In a
    prediction without measured power the load is its expected value, P times the share of time on at the ambient
    temperature. The odds of being on may also depend on `COVARIATES`; the shares `share_…` hold in motion, long after
    the trip's start, with half a charge and closed doors.

    `memory_s` is the time in which the load forgets its state: it switches on at the rate share/memory and off at
    (1 − share)/memory, so it stays on for memory/(1 − share) on average.
    """

    id: ClassVar[str] = "switching_load"
    label: ClassVar[str] = "load that switches"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "P·s, s on or off (hidden)"
    source: ClassVar[str] = "two-state Markov chain in continuous time, decoded as in Rabiner, Proc. IEEE 77 (1989)"
    parameters: ClassVar[Parameters] = (
        # electric heaters of articulated buses have 40 to 60 kW
        Size("power_w", "W", 0.0, 1000.0, 0.0, 6e4, least=100.0),
        Choice("share_0c", "1", 0.5, 0.2, 0.0, 1.0, label="share of time on at 0 °C"),
        Choice("share_10c", "1", 0.5, 0.2, 0.0, 1.0, label="share of time on at 10 °C"),
        Choice("share_20c", "1", 0.5, 0.2, 0.0, 1.0, label="share of time on at 20 °C"),
        Choice("share_30c", "1", 0.5, 0.2, 0.0, 1.0, label="share of time on at 30 °C"),
        Choice("memory_s", "s", 60.0, 30.0, 1.0, 7200.0, label="memory"),
        Choice("by_standstill", "1", 0.0, 1.0, -10.0, 10.0, label="log-odds of being on at standstill"),
        Choice("by_start", "1", 0.0, 1.0, -10.0, 10.0, label="log-odds of being on at the trip's start"),
        Choice("by_soc", "1", 0.0, 2.0, -20.0, 20.0, label="log-odds of being on by the state of charge"),
        Choice("by_door", "1", 0.0, 1.0, -10.0, 10.0, label="log-odds of being on with doors open"),
    )
    searched: ClassVar[str] = "states"
    mistaken_for: ClassVar[Names] = (
        "auxiliary_power",
        "hvac_power",
        "cabin_warmup",
        "passenger_heat",
        "standstill_load",
    )
    separated_by: ClassVar[str] = "an hour at standstill: the power stands at two levels"
    power_w: Any
    share_0c: Any
    share_10c: Any
    share_20c: Any
    share_30c: Any
    memory_s: Any
    by_standstill: Any
    by_start: Any
    by_soc: Any
    by_door: Any

    def shares(self) -> Real:
        """Share of time on at each of `KNOTS_C`."""
        return jnp.stack([jnp.asarray(x) for x in (self.share_0c, self.share_10c, self.share_20c, self.share_30c)])

    def by(self) -> Real:
        """Log-odds of being on by each of `COVARIATES`."""
        return jnp.stack([jnp.asarray(getattr(self, c.name)) for c in COVARIATES])

    def power(self, row: Row, car: Car, point: Point) -> Real:
        channel = state_channel(self.id)
        if row.has(channel):
            return self.power_w * row.channels[channel]
        log_odds = jnp.sum(self.by() * covariates_of(row))
        return self.power_w * expected_share(row.get("ambient_temp_c", USUAL_C), self.shares(), log_odds)


class SecondSwitchingLoad(SwitchingLoad):
    """Another load that is on or off, independent of the first."""

    id: ClassVar[str] = "second_switching_load"
    label: ClassVar[str] = "second load that switches"


SWITCHING_LOADS = (SwitchingLoad, SecondSwitchingLoad)  # in the order in which they are found
