"""What a sequence model reads of a trip: logged channels, or the kernel's own terms of the machine stage."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hdev_jax.errors import InputError
from hdev_jax.learn.sequences import Trip
from hdev_jax.physics import Driveline, Machine, Vehicle
from hdev_jax.physics.losses import CopperLoss, InverterLoss, IronLoss
from hdev_jax.segments import Segments

__all__ = ["Channels", "KernelTerms", "Source"]

SHAFT = ("motor_torque_nm", "motor_speed_radps")
W_PER_KW = 1000.0
PIECE = 8192  # rows: trips of any length share one compilation of the kernel


@runtime_checkable
class Source(Protocol):
    """Input columns `[row, column]` of a trip, and their names."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def __call__(self, trip: Trip) -> Float[np.ndarray, "row column"]: ...


@dataclass(frozen=True)
class Channels:
    """Logged channels as they are: motor torque and vehicle speed in paper 2, section III-A."""

    names: tuple[str, ...] = ("motor_torque_nm", "speed_mps")

    def __call__(self, trip: Trip) -> Float[np.ndarray, "row column"]:
        return trip.columns(self.names)


@dataclass(frozen=True)
class KernelTerms:
    """Battery power [kW] per unit of each coefficient of the machine stage: columns of the kernel's own Jacobian.

    The machine's two efficiencies (paper 2, equations 6 and 10) and the losses of copper, iron and inverter are the
    first six; `order` 2 adds how efficiency bends with torque and speed: copper loss times speed, shaft power times
    |torque| and times |speed| (torque in 100 Nm, speed in 500 rad/s, so that columns are of like size).

    Raises `InputError` where the log lacks torque or speed of the motor.
    """

    order: int = 2

    @property
    def names(self) -> tuple[str, ...]:
        first = ("driving", "regenerating", "copper_loss", "iron_loss_1", "iron_loss_2", "inverter_loss")
        return first + (("copper_loss·speed", "power·|torque|", "power·speed") if self.order > 1 else ())

    def __call__(self, trip: Trip) -> Float[np.ndarray, "row column"]:
        if not trip.segments.has(*SHAFT):
            raise InputError(f"trip {trip.name}: regressors from the kernel need {' and '.join(SHAFT)}")
        torque, speed = (trip.inputs[k] for k in SHAFT)
        columns = _machine_columns(torque, speed) / W_PER_KW
        if self.order > 1:
            power, bend, turn = torque * speed / W_PER_KW, np.abs(torque) / 100.0, np.abs(speed) / 500.0
            more = np.stack([columns[:, 2] * turn, power * bend, power * turn], axis=1)
            columns = np.concatenate([columns, more], axis=1)
        return columns


def _machine_columns(torque: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """∂P/∂θ [W per unit] of each row, at efficiency 1 and no losses."""
    count = -(-len(torque) // PIECE)
    padded = [np.concatenate([x, np.zeros(count * PIECE - len(x))]).reshape(count, PIECE) for x in (torque, speed)]
    parts = [np.asarray(_jacobian(t, w)) for t, w in zip(*padded, strict=True)]
    return np.concatenate(parts)[: len(torque)]


@jax.jit
def _jacobian(torque: Any, speed: Any) -> Any:
    zero = jnp.zeros_like(torque)
    one, none = jnp.ones_like(torque), jnp.zeros(torque.shape, int)
    rows = Segments(
        trip=none, vehicle=none, time_s=zero, duration_s=one, distance_m=zero, speed_start_mps=zero,
        speed_end_mps=zero, channels={SHAFT[0]: torque, SHAFT[1]: speed},
    )  # fmt: skip

    def power(theta: Any) -> Any:
        losses = (
            CopperLoss(w_per_nm2=theta[2]),
            IronLoss(w_per_radps=theta[3], w_per_radps2=theta[4]),
            InverterLoss(standby_w=0.0, per_nm_w=theta[5]),
        )
        machine = Machine(motoring_efficiency=theta[0], regenerating_efficiency=theta[1])
        whole = Vehicle(losses, mass_kg=1.0, driveline=Driveline(1.0), machine=machine, entry="shaft")
        return whole.power(rows)

    return jax.jacfwd(power)(jnp.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0]))
