"""Effects with a state that no channel of the log shows: a load that is on or off."""

from typing import Any, ClassVar

import jax.numpy as jnp

from hdev_jax.physics.effect import Car, Effect, Names, Parameters, Point, Real, Row, Stage
from hdev_jax.physics.parameter import Choice, Size

__all__ = ["KNOTS_C", "SWITCHING_LOADS", "SecondSwitchingLoad", "SwitchingLoad", "expected_share", "state_channel"]

KNOTS_C = (0.0, 10.0, 20.0, 30.0)  # ambient temperatures at which the share of time on is given
USUAL_C = 15.0  # where the log has no temperature; the shares are one number then


def state_channel(effect_id: str) -> str:
    """The channel that holds the state of an effect where it has been decoded: the share of each row that it is on."""
    return f"derived:{effect_id}"


def expected_share(temp_c: Any, shares: Any) -> Any:
    """Share of time on at an ambient temperature [°C], linear between `KNOTS_C` and constant beyond; any shape."""
    shares = jnp.asarray(shares)
    return jnp.interp(jnp.asarray(temp_c, shares.dtype), jnp.asarray(KNOTS_C, shares.dtype), shares)


class SwitchingLoad(Effect):
    """A consumer that is on or off: P·s. Which rows it is on in is a hidden state, s = 1 while it is on.

    Where the state has been decoded from measured power, it is the channel `derived:switching_load`. Where it has not
    (a prediction without measured power), the load is its expected value, by the share of time on at the ambient
    temperature. It forgets its state within `memory_s`: the rates of switching on and off are share/memory and
    (1 − share)/memory, so that it stays on for memory/(1 − share) on average.
    """

    id: ClassVar[str] = "switching_load"
    label: ClassVar[str] = "load that switches"
    stage: ClassVar[Stage] = "battery"
    equation: ClassVar[str] = "P·s, s on or off (hidden)"
    source: ClassVar[str] = "two-state Markov chain in continuous time, decoded as in Rabiner, Proc. IEEE 77 (1989)"
    parameters: ClassVar[Parameters] = (
        # electric heaters of articulated buses have 40 to 60 kW
        Size("power_w", "W", 0.0, 1000.0, 0.0, 6e4, least=50.0),
        Choice("share_0c", "1", 0.5, 0.2, 0.0, 1.0, label="share of time on at 0 °C"),
        Choice("share_10c", "1", 0.5, 0.2, 0.0, 1.0, label="share of time on at 10 °C"),
        Choice("share_20c", "1", 0.5, 0.2, 0.0, 1.0, label="share of time on at 20 °C"),
        Choice("share_30c", "1", 0.5, 0.2, 0.0, 1.0, label="share of time on at 30 °C"),
        Choice("memory_s", "s", 60.0, 30.0, 1.0, 7200.0, label="memory"),
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

    def shares(self) -> Real:
        """Share of time on at each of `KNOTS_C`."""
        return jnp.stack([jnp.asarray(x) for x in (self.share_0c, self.share_10c, self.share_20c, self.share_30c)])

    def power(self, row: Row, car: Car, point: Point) -> Real:
        channel = state_channel(self.id)
        if row.has(channel):
            return self.power_w * row.channels[channel]
        return self.power_w * expected_share(row.get("ambient_temp_c", USUAL_C), self.shares())


class SecondSwitchingLoad(SwitchingLoad):
    """Another load that is on or off, independent of the first."""

    id: ClassVar[str] = "second_switching_load"
    label: ClassVar[str] = "second load that switches"


SWITCHING_LOADS = (SwitchingLoad, SecondSwitchingLoad)  # in the order in which they are found
