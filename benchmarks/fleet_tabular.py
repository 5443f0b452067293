"""Tabular values of the fleet's sheets at which their energy errors are those of paper 1, tables 1 and 2.

    python benchmarks/fleet_tabular.py            # prints the c_rr and C_d·A that hdev_jax/fleet/variants.py holds

Models A to D are brought to the errors of table 1 (−15.5, −5.18, −7.25, +34.1 %), each by a factor on its tabular
c_rr; the others get one common factor on both values, with which the whole fleet is at the −40.4 % of table 2. Only
the tables move: what the vehicles are, and what they take, stays."""

import equinox as eqx
import jax
import numpy as np
from scipy.optimize import brentq

from hdev_jax.fleet import FleetConfig, FleetVehicle, simulate
from hdev_jax.report.fleet.sources import PAPER_FLEET_PE, PAPER_MODEL_PE

__all__ = ["main"]

_ROWS = 2**15


@eqx.filter_jit
def _energy(vehicle, segments, weight):
    return (vehicle.energy(segments) * weight).sum()


class _Sheet:
    """Energy by the sheet of one vehicle, as a function of a factor on its tabular values."""

    def __init__(self, v: FleetVehicle):
        self.v = v
        at = np.minimum(np.arange(_ROWS * (-(-len(v) // _ROWS))), len(v) - 1)
        self.segments, self.weight = v.segments.take(at), (np.arange(len(at)) < len(v)).astype(float)
        self.measured = float(v.energy_wh.sum())
        self.air = 0.0 if v.variant.model else 1.0  # whether the factor acts on the drag area too

    def energy(self, factor: float) -> float:
        v = self.v.tabular
        values = (v.effect("rolling").c_rr * factor, v.effect("aero").cda_m2 * factor**self.air)
        car = eqx.tree_at(lambda c: (c.effect("rolling").c_rr, c.effect("aero").cda_m2), v, values)
        return float(_energy(car, self.segments, self.weight))


def main() -> None:
    """Solve for the factors and print the values."""
    jax.config.update("jax_enable_x64", True)
    sheets = [_Sheet(v) for v in simulate(FleetConfig()).vehicles]
    factor, total = {}, 0.0
    for s in sheets:
        if model := s.v.variant.model:
            wanted = s.measured * (1 + PAPER_MODEL_PE[model] / 100)
            factor[s.v.id] = brentq(lambda k, s=s, w=wanted: s.energy(k) - w, 0.3, 3.0, xtol=1e-5)
            total += wanted
    others = [s for s in sheets if not s.v.variant.model]
    wanted = sum(s.measured for s in sheets) * (1 + PAPER_FLEET_PE / 100) - total
    common = brentq(lambda k: sum(s.energy(k) for s in others) - wanted, 0.3, 3.0, xtol=1e-4)
    for s in sheets:
        k, v = factor.get(s.v.id, common), s.v.variant
        error = 100 * (s.energy(k) / s.measured - 1)
        print(f"{v.id:24s} c_rr {v.c_rr[0] * k:.5f}  cda_m2 {v.cda_m2[0] * k**s.air:.3f}  error {error:+.2f} %")


if __name__ == "__main__":
    main()
