"""What poorly known thresholds, time constants and other sizes leave open of a found effect's sizes.

A fit knows a size at the shapes where it stands, or at best near them. A log of a few trips may allow other shapes as
well, a limit of heating anywhere between two trips' temperatures, with quite another size at each. And of an effect
that may have two sizes it may show one alone, a loss that grows with the speed or with its square, though both are
there: the one then holds some of the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import optimize, stats

from hdev_jax.diagnosis.candidates.candidate import Candidate, Grids, beyond
from hdev_jax.diagnosis.candidates.plan import Plan
from hdev_jax.diagnosis.competition.state import State
from hdev_jax.diagnosis.scores.evidence import Evidence, Score
from hdev_jax.diagnosis.scores.passes import both_looks
from hdev_jax.diagnosis.training import Training
from hdev_jax.inference import Calibration
from hdev_jax.physics import RegenEfficiency, Shape

__all__ = ["Open", "left_open", "other_size", "shapes_of"]

BETWEEN = 3  # steps from one value of the library's grid to the next
BEYOND = 2  # of its steps, on either side, that are looked at too
NEGLIGIBLE = 1e-3  # likelihood over the best one's
POINTS, REACH = 41, 4.0  # of another size, over so many standard errors to either side

UNDECIDED = 0.05  # share of a column outside the span of all others, below which inexact forms decide on its size
RECOVERS_LESS = (0.0, 0.2)  # relative: 0.03 (SUMO's vehicles), 0.1 (FASTSim's), 0.2 (small machines at low load)


@dataclass(frozen=True)
class Open:
    """Of one parameter: how far `away` it would be at each set of shapes, or of another size, that the log allows, how
    likely these are (`share`), and for a size its standard error (`inside`) where it was found. In its unit."""

    away: Float[np.ndarray, " set"]
    share: Float[np.ndarray, " set"]
    inside: float = 0.0

    def error(self, inside: float | None = None) -> float:
        """The root mean square of what it may be off by, `inside` in place of its own where that is given."""
        inside = self.inside if inside is None else inside
        return float(np.hypot(inside, np.sqrt(np.sum(self.share * self.away**2))))

    def interval(self, level: float, freedom: int, inside: float | None = None) -> tuple[float, float]:
        """How far below and above the central interval reaches: of Student's t at each set of shapes, mixed."""
        inside = self.inside if inside is None else inside
        if not np.isfinite(inside):
            return -np.inf, np.inf
        wide = max(inside, 1e-6 * float(np.ptp(self.away)), 1e-300)

        def at(share: float) -> float:
            each = self.away + wide * float(stats.t.ppf(share, freedom))  # the mixture's lies between these
            beyond_it = wide + 1e-9 * float(np.max(np.abs(each)))  # more than rounding
            low, high = float(each.min()) - beyond_it, float(each.max()) + beyond_it

            def past(way: float) -> float:
                x = low + way * (high - low)
                return float(np.sum(self.share * stats.t.cdf((x - self.away) / wide, freedom))) - share

            return low + float(optimize.root_scalar(past, bracket=(0.0, 1.0)).root) * (high - low)

        return at(0.5 - 0.5 * level), at(0.5 + 0.5 * level)


def left_open(training: Training, state: State, s: Score, reported: Calibration) -> dict[str, Open]:
    """Sizes and shapes of a found effect over a grid of its shapes, as likely as rows and usual values make them; or,
    of an effect without shapes, its sizes over another that it may have, as likely as rows make it.

    All other coefficients are fitted at every point, by the least squares that found it, generalised or ordinary;
    where another size is open, by those that its own is `reported` by. An effect with neither is open to what an
    undeclared regenerating efficiency would change. Empty for switches, and for effects with a search of their own.

    **Returns:** what is open, by parameter.
    """
    c, names = s.candidate, shapes_of(s.candidate)
    if not names:
        other = other_size(c)
        found = _other_open(training, state, s, other, reported) if other else {}
        return found or ({} if c.effect.searched else _undeclared(training, state, s))
    effect = state.fit.vehicle.effect(c.id)
    here = {n: float(np.asarray(getattr(effect, n))) for n in names}
    grids = {n: _wide(c, n, here[n], training.facts.row_s) for n in names}
    cells = {n: dict(zip(g, np.gradient(g) if len(g) > 1 else [1.0], strict=True)) for n, g in grids.items()}
    plan, white, plain = _apart(training, state, c, grids | {n: (v,) for n, v in c.shapes if n not in names})
    evidence = plain if s.plain else white
    same = [k for k in plan.candidates if (k.sizes, k.groups) == (c.sizes, c.groups)]
    totals = evidence.totals()
    points, found, inside = [], np.array([np.nan]), np.array([np.nan])
    for k in same:
        gain, beta = evidence.gain(totals, k.columns)
        shapes = np.array([dict(k.shapes)[n] for n in names])
        stands = all(x == here[n] for n, x in zip(names, shapes, strict=True))
        if stands:
            found, inside = beta, evidence.estimate(k)[1]
        # what is too small to name is possible all the same
        if np.isfinite(gain) and np.all(np.isfinite(beta)) and not c.effect.implausible(_with_sizes(k, beta)):
            usual = [(x - c.parameter(n).null) / c.parameter(n).scale for n, x in zip(names, shapes, strict=True)]
            cell = [np.log(cells[n][x]) for n, x in zip(names, shapes, strict=True)]
            points.append((gain - 0.5 * float(np.sum(np.square(usual))) + float(np.sum(cell)), beta, shapes))
    if not points or not np.all(np.isfinite([*found, *inside])):
        return {}
    likely = np.array([p[0] for p in points])
    share = np.exp(likely - likely.max())
    kept = share > NEGLIGIBLE
    share = share[kept] / share[kept].sum()
    away = np.array([[*(p[1] - found), *(p[2] - [here[n] for n in names])] for p in points])[kept]
    inside = [*inside, *(0.0 for _ in names)]
    return {n: Open(away[:, k], share, float(inside[k])) for k, n in enumerate((*c.sizes, *names))}


def _with_sizes(c: Candidate, beta: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Values of a candidate's parameters, where its sizes differ from their nulls by `beta`."""
    return dict(c.shapes) | {n: c.parameter(n).null + float(b) for n, b in zip(c.sizes, beta, strict=True)}


def _apart(training: Training, state: State, c: Candidate, grids: Grids) -> tuple[Plan, Evidence, Evidence]:
    """Forms of a found effect on these grids, and evidence without it by generalised and by ordinary least squares."""
    plan = training.plan(state.fit.vehicle.minus(c.id), [c.effect], grids)
    baseline = training.baseline(_without(state.fit, c.id), training.noise(state.fit))
    with_it = float(np.mean((training.measured - state.fit.predicted) ** 2))
    return plan, *both_looks(baseline, plan, variance=with_it)[:2]


def _other_open(training: Training, state: State, s: Score, other: str, reported: Calibration) -> dict[str, Open]:
    """Sizes of a found effect over the plausible values of another one, which it was found without."""
    c = s.candidate
    plan, white, plain = _apart(training, state, c, {})
    by_gls = any(r.known for r in reported.table.free if r.path.startswith(f"effects.{c.id}."))
    evidence = white if by_gls else plain
    own = next((k for k in plan.candidates if k.sizes == c.sizes), None)
    both = next((k for k in plan.candidates if {*k.sizes} == {*c.sizes, other}), None)
    if own is None or both is None:
        return {}
    place, p = both.sizes.index(other), c.parameter(other)
    beta, error = (float(x[place]) for x in evidence.estimate(both))
    found, inside = evidence.estimate(own)
    known = np.all(np.isfinite([beta, error, *found, *inside])) and error > 0
    if not known or evidence.left([both.columns[place]]) <= training.settings.absorbed:
        return {}
    per_unit = evidence.traded(own.columns, both.columns[place])

    def possible(x: float) -> bool:
        values = {other: x, **dict(zip(c.sizes, found + per_unit * x, strict=True))}
        return not c.effect.implausible(_with_sizes(both, [values[n] for n in both.sizes]))

    low, high = np.clip(beta + error * np.array([-REACH, REACH]), p.lower - p.null, p.upper - p.null)
    at = np.array([x for x in np.linspace(low, high, POINTS) if possible(float(x))])
    if not len(at):
        return {}
    share = stats.t.pdf((at - beta) / error, max(evidence.count - 1, 1))
    share /= share.sum()
    return {n: Open(x * at, share, float(e)) for n, x, e in zip(c.sizes, per_unit, inside, strict=True)}


def _undeclared(training: Training, state: State, s: Score) -> dict[str, Open]:
    """Sizes of a found effect over what a drive may recover less than it gives, where one efficiency is declared for
    both directions and these rows cannot distinguish that from the effect."""
    c, vehicle = s.candidate, state.fit.vehicle
    if not vehicle.one_efficiency or vehicle.has(RegenEfficiency.id) or c.kind != "size" or None not in c.groups:
        return {}
    beside = training.plan(vehicle, [RegenEfficiency])
    if not beside.candidates or both_looks(training.baseline(state.fit), beside)[0].left([0]) > UNDECIDED:
        return {}
    plan = training.plan(vehicle.minus(c.id), [c.effect, RegenEfficiency])
    evidence = both_looks(training.baseline(_without(state.fit, c.id), training.noise(state.fit)), plan)[0]
    own = next((k for k in plan.candidates if k.sizes == c.sizes and k.id == c.id), None)
    other = next(k for k in plan.candidates if k.id == RegenEfficiency.id)
    if own is None:
        return {}
    per_unit = evidence.traded(own.columns, other.columns[0])
    at = np.linspace(*RECOVERS_LESS, POINTS)
    each = zip(c.sizes, per_unit, evidence.estimate(own)[1], strict=True)
    return {n: Open(x * at, np.full(POINTS, 1.0 / POINTS), float(e)) for n, x, e in each}


def other_size(c: Candidate) -> str | None:
    """The one other size that an effect without shapes may have beside those that it was found with; None where there
    is none, or more than one."""
    if c.kind != "size" or c.effect.searched or any(g is not None for g in c.groups):
        return None
    if any(not p.has_column for p in c.effect.parameters):
        return None
    more = {frozenset({*v} - {*c.sizes}) for v in c.effect.variants if {*v} > {*c.sizes}}
    others = [n for m in more if len(m) == 1 for n in m]
    return others[0] if len(others) == 1 else None


def shapes_of(c: Candidate) -> list[str]:
    """Its shapes that lie on a grid beside sizes."""
    if c.kind != "size" or c.effect.searched or any(g is not None for g in c.groups):
        return []
    return [n for n, _ in c.shapes if "[" not in n and isinstance(c.parameter(n), Shape)]


def _wide(c: Candidate, name: str, here: float, row_s: float) -> tuple[float, ...]:
    """All of the library's grid and some way beyond, in small steps, and the fitted value."""
    p = c.parameter(name)
    grid = np.array(p.grid) * (row_s if p.in_rows else 1.0)
    if len(grid) < 2:
        return (here,)
    steps = [*np.interp(np.arange(0, len(grid) - 1 + 1e-9, 1 / BETWEEN), np.arange(len(grid)), grid)]
    for _ in range(BEYOND):
        steps = [beyond(steps[1], steps[0]), *steps, beyond(steps[-2], steps[-1])]
    return tuple(float(x) for x in np.unique([*np.clip(steps, p.lower, p.upper), here]))


def _without(fit: Calibration, effect_id: str) -> Calibration:
    """The fit with an effect taken out and all else as it is."""
    kept = np.array([not c.path.startswith(f"effects.{effect_id}.") for c in fit.table.free], dtype=bool)
    return replace(
        fit, vehicle=fit.vehicle.minus(effect_id), table=fit.table.minus(effect_id), values=fit.values[kept],
        sd=fit.sd[kept], covariance=fit.covariance[np.ix_(kept, kept)],
    )  # fmt: skip
