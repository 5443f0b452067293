"""What thresholds and time constants that a log hardly tells leave open of a found effect's sizes.

A fit knows a size at the shapes where it stands, or at best near them. A log of a few trips may allow other shapes as
well, a limit of heating anywhere between two trips' temperatures, with quite another size at each.
"""

from dataclasses import dataclass, replace

import numpy as np

from hdev_jax.diagnosis.candidates import Candidate, plan_of
from hdev_jax.diagnosis.evidence import Score
from hdev_jax.diagnosis.look import Loop, Search
from hdev_jax.diagnosis.sums import both_looks
from hdev_jax.inference import Calibration

__all__ = ["Open", "left_open", "shapes_of"]

BETWEEN = 3  # steps from one value of the library's grid to the next
BEYOND = 2  # of its steps, on either side, that are looked at too
NEGLIGIBLE = 1e-3  # likelihood over the best one's


@dataclass(frozen=True)
class Open:
    """Of one parameter: `spread` over the shapes that the log allows, and for a size its standard error (`inside`) at
    the shapes that were found. In the parameter's unit."""

    spread: float
    inside: float = 0.0

    def error(self, fitted: float | None) -> float:
        """The standard error in all: of a size that was fitted at these shapes, or of one with them (None: held)."""
        return float(np.hypot(self.inside if fitted is None else fitted, self.spread))


def left_open(problem: Loop, state: Search, s: Score) -> dict[str, Open]:
    """Sizes and shapes of a found effect over a grid of its shapes, each as likely as the rows say.

    All other coefficients are fitted at every point. Rows and noise are those that found it: whitened ones, or trips
    alone. Empty for effects without such shapes, for switches, and for what is sought elsewhere than on a grid.

    **Returns:** what is open, by parameter.
    """
    c = s.candidate
    names = shapes_of(c)
    if not names:
        return {}
    facts = problem.facts
    effect = state.fit.vehicle.effect(c.id)
    here = {n: float(np.asarray(getattr(effect, n))) for n in names}
    grids = {n: _wide(c, n, here[n], facts.row_s) for n in names}
    grids |= {n: (v,) for n, v in c.shapes if n not in names}
    plan = plan_of(state.fit.vehicle.minus(c.id), [c.effect], facts, problem.target, grids)
    same = [k for k in plan.candidates if (k.sizes, k.groups) == (c.sizes, c.groups)]
    white, plain, _ = both_looks(problem.ground(_without(state.fit, c.id), problem.noise(state.fit)), plan)
    evidence = plain if s.plain else white
    totals = evidence.totals()
    gains = np.array([evidence.gain(totals, k.columns)[0] for k in same])
    weight = np.exp(gains - np.max(gains))
    at = next(i for i, k in enumerate(same) if all(dict(k.shapes)[n] == here[n] for n in names))
    kept = np.flatnonzero(weight > NEGLIGIBLE)
    sizes = np.array([evidence.estimate(same[i])[0] for i in kept])
    found, error = evidence.estimate(same[at])
    shapes = np.array([[dict(same[i].shapes)[n] for n in names] for i in kept])
    away = np.concatenate([sizes - found, shapes - np.array([here[n] for n in names])], axis=1)
    spread = np.sqrt(np.average(away**2, axis=0, weights=weight[kept]))
    inside = [*error, *(0.0 for _ in names)]
    return {n: Open(float(x), float(e)) for n, x, e in zip((*c.sizes, *names), spread, inside, strict=True)}


def shapes_of(c: Candidate) -> list[str]:
    """Its shapes that lie on a grid beside sizes."""
    if c.kind != "size" or c.effect.searched or any(g is not None for g in c.groups):
        return []
    return [n for n, _ in c.shapes if "[" not in n and c.parameter(n).kind == "shape"]


def _wide(c: Candidate, name: str, here: float, row_s: float) -> tuple[float, ...]:
    """All of the library's grid and some way beyond, in small steps, and where the fit stands."""
    p = c.parameter(name)
    grid = np.array(p.grid) * (row_s if p.in_rows else 1.0)
    if len(grid) < 2:
        return (here,)
    steps = np.interp(np.arange(0, len(grid) - 1 + 1e-9, 1 / BETWEEN), np.arange(len(grid)), grid)
    below = steps[0] - (steps[1] - steps[0]) * np.arange(1, BEYOND + 1)
    above = steps[-1] + (steps[-1] - steps[-2]) * np.arange(1, BEYOND + 1)
    every = np.clip(np.concatenate([below, steps, above]), p.lower, p.upper)
    return tuple(float(x) for x in np.unique([*every, here]))


def _without(fit: Calibration, effect_id: str) -> Calibration:
    """The fit with an effect taken out and all else as it is."""
    kept = np.array([not c.path.startswith(f"effects.{effect_id}.") for c in fit.table.free], dtype=bool)
    return replace(
        fit, vehicle=fit.vehicle.minus(effect_id), table=fit.table.minus(effect_id), values=fit.values[kept],
        sd=fit.sd[kept], covariance=fit.covariance[np.ix_(kept, kept)],
    )  # fmt: skip
