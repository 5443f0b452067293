"""Why a candidate was rejected: an enumerated kind with its numbers, and the one place where it is worded."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

__all__ = ["SENTENCES", "UNTRIED", "Kind", "Rejection"]


class Kind(StrEnum):
    """The gate that turned a candidate down (`candidates[].kind` of diagnosis.json), or that it is in the model."""

    UNAVAILABLE = "unavailable"
    NO_EFFECT = "no_effect"
    ABSORBED = "absorbed"
    TOO_FEW_CLUSTERS = "too_few_clusters"
    IMPLAUSIBLE = "implausible"
    NOT_CONFIRMED = "not_confirmed"
    NOT_SIGNIFICANT = "not_significant"
    CONTRADICTED = "contradicted"
    SMALL = "small"
    OUTSCORED = "outscored"
    REFIT = "refit"
    OPPOSITE = "opposite_signs"
    FAR = "far_from_table"
    PLACEBO = "placebo"
    UNSTABLE = "unstable"
    SUPERFLUOUS = "superfluous"
    NOT_HELD_OUT = "not_held_out"
    INSTRUMENT = "instrument"
    MISSING_CHANNEL = "missing_channel"
    FOUND = "found"
    DECLARED = "declared"


UNTRIED = (Kind.UNAVAILABLE, Kind.NO_EFFECT, Kind.DECLARED)


@dataclass(frozen=True)
class Rejection:
    """A gate's answer: which gate, and the numbers behind it."""

    kind: Kind
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        """In words; `detail` among its numbers replaces them where an effect has tests of its own."""
        if detail := self.numbers.get("detail"):
            return str(detail)
        return SENTENCES[self.kind].format(**{"unit": "trips"} | dict(self.numbers))


SENTENCES = {
    Kind.UNAVAILABLE: "not tried: {reason}",
    Kind.NO_EFFECT: "no effect on this log",
    Kind.ABSORBED: "absorbed: this log cannot distinguish it from {by}",
    Kind.TOO_FEW_CLUSTERS: "not decidable: at least {least} {unit} are needed for training, there are {there}",
    Kind.IMPLAUSIBLE: "its best estimate has the wrong sign, is out of range or is too small to matter",
    Kind.NOT_CONFIRMED: "not confirmed by cross-validation: does not lower the error on {unit} left out of the fit",
    Kind.NOT_SIGNIFICANT: "not significant over the whole library (FDR-adjusted p = {q:.2g})",
    Kind.CONTRADICTED: (
        "its generalised least-squares estimate is significantly smaller than {share:.0%} of its ordinary "
        "least-squares estimate"
    ),
    Kind.SMALL: "explains {share:.1%} of the squared error; a name needs {least:.0%}",
    Kind.OUTSCORED: "explains less than the chosen effects, or too little for its number of coefficients",
    Kind.REFIT: "out of range or not significant in the joint refit",
    Kind.OPPOSITE: "its generalised and its ordinary least-squares estimate are significant with opposite signs",
    Kind.FAR: "it would move {name} to {z:+.1f} prior sd from the sheet's value",
    Kind.PLACEBO: "a placebo ({how}) does as well",
    Kind.UNSTABLE: "ranks first in only {percent:.0f} % of resampled sets of {unit}",
    Kind.SUPERFLUOUS: "not significant given {beside}",
    Kind.NOT_HELD_OUT: "rejected by the held-out trips: the model with all found effects predicts them worse",
    Kind.INSTRUMENT: "no instrument fault is named, as {percent:.0f} % of the remaining variance is not noise",
    Kind.MISSING_CHANNEL: (
        "no payload and no instrument fault is named, as {percent:.0f} % of the remaining variance behaves like a "
        "channel that the log lacks ({channels})"
    ),
    Kind.FOUND: "found",
    Kind.DECLARED: "declared in the sheet",
}
