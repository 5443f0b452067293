"""The efficiency switch and the electric machine with its inverter."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from hdev_jax.physics.parameter import as_array

__all__ = ["Machine", "switch"]


def switch(output: Any, driving: Any, braking: Any) -> Array:
    """Output over efficiency while driving, output times efficiency while braking (paper 1, equation 5).

    Paper 2, equations 6, 10 and 11, is the same with one efficiency for each direction. At zero both branches are
    zero; the slope there is the braking one ("otherwise" in equation 5). Finite for every output and every positive
    efficiency, forward and reverse, since neither branch divides by the output.
    """
    return jnp.where(jnp.asarray(output) > 0, output / driving, output * braking)


class Machine(eqx.Module):
    """Motor and inverter: P_e = P_m/η_mot driving, P_m·η_reg braking (paper 2, equations 5-12)."""

    motoring_efficiency: Any = eqx.field(converter=as_array, default=1.0)
    regenerating_efficiency: Any = eqx.field(converter=as_array, default=1.0)
