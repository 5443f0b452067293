"""The numbers that decide what is named: meaning, unit, where they come from.

What half and double of each do to the study of planted effects is in docs/settings.md, which
`python -m experiments configs/studies/settings.toml` measures. Numbers of computation (rows in a chunk, points of a
grid, rounds of a search, draws, tolerances of a solver), what a cluster is (`hdev_jax/inference/clusters.py`) and which
rivals a resampled set has (`gates/gates.py`) are not among them.
"""

from dataclasses import dataclass, field, fields
from typing import Any

__all__ = ["FLEET_SETTINGS", "SETTINGS", "FleetSettings", "Settings", "described"]


def _number(default: Any, meaning: str, unit: str, source: str) -> Any:
    return field(default=default, metadata={"meaning": meaning, "unit": unit, "source": source})


@dataclass(frozen=True)
class Settings:
    """Numbers that decide; `described` lists them with meaning, unit and source."""

    fdr: float = _number(
        0.05, "highest FDR-adjusted p-value of a named effect", "1", "Benjamini and Hochberg, JRSS B 57 (1995)"
    )

    # what a candidate costs: its gain in log-likelihood has to pay for its numbers
    size_cost: float = _number(
        3.0, "cost of each coefficient", "log-likelihood", "BIC for 400 independent rows: ½·ln 400 (Schwarz 1978)"
    )
    shape_cost: float = _number(1.5, "cost of each number chosen on a grid", "log-likelihood", "BIC for 20: ½·ln 20")
    close: float = _number(
        0.85, "share of the best gain above which another candidate is about as good", "1", "chosen on seeds 1-99"
    )
    ahead: float = _number(
        3.0,
        "gain that is more than chance: in cross-validation, and of one candidate over another",
        "log-likelihood",
        "odds of 20 to 1 (Kass and Raftery, JASA 90, 1995: strong)",
    )

    # gates
    absorbed: float = _number(
        3e-3, "share of a column outside the span of the fitted coefficients, below which it is absorbed", "1",
        "collinearity: standard error 18 times that of an orthogonal column",
    )  # fmt: skip
    agreed: float = _number(
        0.25, "smallest ratio of the GLS estimate, plus two standard errors, to the OLS estimate", "1",
        "chosen on seeds 1-99",
    )  # fmt: skip
    placebo_level: float = _number(
        0.01, "share of placebos with flipped signs that may gain as much", "1", "permutation test, 1 %"
    )
    placebos: int = _number(199, "placebos with flipped signs", "draws", "1 of 199 may do as well: p of 2/200")
    shifts: int = _number(
        19, "placebos shifted in time, none of which may gain as much", "draws", "permutation test, 5 %"
    )
    stable: float = _number(
        0.25, "share of resampled sets of clusters in which the effect, its class or a wider form ranks first", "1",
        "Meinshausen and Bühlmann, JRSS B 72 (2010), far below their 0.6: sets of 8 trips differ much",
    )  # fmt: skip
    switch_low: float = _number(
        0.4, "smallest estimated step of a switch over its full step; the largest is the reciprocal", "1",
        "half, less two standard errors",
    )  # fmt: skip

    # a joint refit
    stands: float = _number(2.6, "least |t| of a size in the joint refit", "standard errors", "1 %, two-sided")
    agrees: float = _number(
        0.9878, "level of the test that ordinary and generalised least squares agree on a size", "1",
        "Hausman, Econometrica 46 (1978): 2.25 sd, one-sided",
    )  # fmt: skip
    known: float = _number(
        2.0,
        "factor by which the GLS standard error is smaller for GLS to be tried first",
        "1",
        "relative efficiency 4",
    )

    moved: float = _number(
        3.0, "largest |prior_z| to which an effect may move a declared coefficient", "sd", "0.3 %, two-sided"
    )

    # is X significant given Y
    stays: float = _number(
        0.01, "largest p-value at which an effect stays, given those added later", "1",
        "Wald test, 1 %: it entered at some 0.1 %, the FDR over the library",
    )  # fmt: skip
    wald: float = _number(
        0.05, "largest p-value at which an effect is significant given another of its class", "1", "Wald test, 5 %"
    )
    class_share: float = _number(
        0.8, "least share of an effect's gain that another of its class reaches", "1", "chosen on seeds 1-99"
    )
    inexact: float = _number(
        0.2, "relative error of an effect's equation; effects that differ by less are one class", "1",
        "efficiencies and drag by FASTSim's and SUMO's vehicles: 5 to 20 % off any closed form",
    )  # fmt: skip

    correlated: float = _number(
        0.5, "smallest correlation of the estimates of two found effects for which they may be one class", "1",
        "to save time: effects that share 80 % of their gain have 0.9",
    )  # fmt: skip

    # terms without a name
    unnamed_stricter: float = _number(
        5.0, "factor by which the FDR level is lower for a term without a name", "1", "it names no cause"
    )
    mean_over_swing: float = _number(
        2.0, "largest ratio of a periodic load's mean to its amplitude", "1", "a square wave that is on for 78 % of it"
    )

    # loads that switch in a cycle, modes of some trips
    alike_spread: float = _number(
        0.3, "periodic load: largest sd of its size between trips, over the size", "1", "chosen on seeds 1-99"
    )
    other_waves: float = _number(
        0.1, "periodic load: largest share of its gain from harmonics", "1", "chosen on seeds 1-99"
    )
    least_count: int = _number(
        8, "fewest trips for a mode of some of them; fewest switchings of a load beyond one per trip", "1",
        "as for trips as clusters",
    )  # fmt: skip
    mode_side: int = _number(2, "fewest trips in each mode", "trips", "one is an outlier")
    mode_enough: float = _number(0.01, "p-value above which two values are enough for all trips", "1", "a test at 1 %")

    # loads that switch
    load_alike: float = _number(
        0.5, "largest relative sd of a load's power between trips, and difference of standstill and motion", "1",
        "measured loads of buses have stages: 0.15 to 0.35",
    )  # fmt: skip
    load_steady: float = _number(
        0.15, "share of a load's power by which it may rise or fall while it is on", "1",
        "two loads of a bus 0.01 and 0.08, planted ones at most 0.05, a saw-tooth 0.26 to 0.7",
    )  # fmt: skip
    load_s: float = _number(
        60.0,
        "shortest time on, and off, in a trip, at standstill or in motion, for its power there",
        "s",
        "a minute",
    )
    first_look: int = _number(
        3, "placebos of a load that switches, after which one that gains as much ends the test", "draws", "to save "
        "time: of three and it, one in four",
    )  # fmt: skip
    second_look: int = _number(
        6, "placebos of a load that switches, after which a clear answer ends the test", "draws", "to save time"
    )
    clear: float = _number(
        10.0, "factor from the level of that test at which its answer is clear", "1",
        "adds at most a tenth of the level to the false alarms",
    )  # fmt: skip
    load_sure: float = _number(
        0.8, "least probability of a decoded state, on and off alike", "1",
        "planted loads: 0.81 and more where power and time on are right, 0.72 to 0.76 where not; a car's noise 0.78",
    )  # fmt: skip

    # what remains
    drifts: float = _number(
        0.2,
        "least correlation of neighbouring one-minute means for a residual that drifts",
        "1",
        "4 % of their variance",
    )
    level: float = _number(
        1e-3, "p-value below which remaining structure is reported (a tenth of it for change points and intercepts), a "
        "parameter is added to a found effect, or a cycle differs between trips", "1", "a test at 0.1 %",
    )  # fmt: skip
    least_share: float = _number(
        0.02, "least share of the squared error that an effect or a structure has to explain", "1", "1 % of the error",
    )  # fmt: skip
    least_levels: float = _number(
        0.1, "least share of the variance that random intercepts of trips explain", "1", "chosen on seeds 1-99"
    )

    instrument_share: float = _number(
        0.5, "share of the remaining variance that is structure (of test rows), or behaves like a slope that the log "
        "lacks (of training rows), above which no instrument fault, or no payload error either, is named", "1",
        "more structure than noise: the model's form is wrong",
    )  # fmt: skip

    # notes
    far: float = _number(2.0, "|prior_z| above which a coefficient is flagged", "sd", "5 %, two-sided")
    odd: float = _number(
        0.2, "share of the declared model's squared error above which a single row is reported", "1", "a fifth"
    )
    suspicious: float = _number(
        8.0, "gain above which an undecided candidate is reported", "log-likelihood", "odds of 3,000 to 1"
    )
    hint: float = _number(
        0.1, "p-value, before any correction, above which there is no sign of a candidate", "1", "a test at 10 %"
    )
    half: float = _number(
        0.5,
        "undecided effects: largest adjusted p-value, and share of the differences between trips to be ruled out",
        "1",
        "half",
    )


SETTINGS = Settings()


@dataclass(frozen=True)
class FleetSettings:
    """Numbers that decide what is said of a fleet, beside those of each vehicle."""

    fdr: float = _number(
        0.05, "highest FDR-adjusted p-value of an effect of a type, of a vehicle that differs, of a change", "1",
        "Benjamini and Hochberg, JRSS B 57 (1995)",
    )  # fmt: skip
    least_vehicles: int = _number(
        4, "least number of vehicles of a type that are compared, or whose effects are pooled", "vehicles",
        "a variance between vehicles of three degrees of freedom",
    )  # fmt: skip
    least_trips: int = _number(
        8, "least number of trips for a change of a coefficient", "trips", "as for trips as clusters"
    )
    least_side: int = _number(3, "least trips before and after a change", "trips", "two are a day's weather")
    least_clusters: float = _number(
        2.0, "least number of trips that a vehicle's size rests on, to be added up over vehicles", "trips",
        "the error of one trip is not known",
    )  # fmt: skip
    most_effects: int = _number(6, "effects that a type's vehicles show together at most", "effects", "a bound on time")


FLEET_SETTINGS = FleetSettings()


def described() -> list[dict[str, Any]]:
    """Name, default, meaning, unit and source of each setting."""
    return [{"name": f.name, "default": f.default, **f.metadata} for f in fields(Settings)]
