"""The state of the competition: the fitted vehicle, the effects found, the candidates rejected."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from hdev_jax.diagnosis.candidates.unnamed import Term
from hdev_jax.diagnosis.gates.rejection import Rejection
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.inference import Calibration
from hdev_jax.inference.states import Switching

__all__ = ["Found", "Hidden", "State", "Verdict"]


@dataclass(frozen=True)
class Found:
    """An effect that was added, and on what evidence.

    `alike`: its class, the best first.
    """

    id: str
    score: Score
    q_value: float
    stability: float
    alike: tuple[str, ...]
    gain: float


@dataclass(frozen=True)
class Verdict:
    """A candidate that was not chosen, and why.

    `needed`: how many clusters like these would make it significant; `between`: it differs only between trips, and
    without a sign of it `needed` is for half of the trips' differences; `by_rows`: significant by rows, not yet by
    clusters.
    """

    id: str
    score: float | None
    q_value: float
    rejection: Rejection
    needed: int | None = None
    between: bool = False
    by_rows: bool = False


@dataclass(frozen=True, eq=False)
class Hidden:
    """The loads with a hidden state that the vehicle has: their ids, the model that decodes them, and the share of
    each training row that each is on."""

    ids: tuple[str, ...]
    model: Switching
    on: Float[np.ndarray, "row load"]


@dataclass(frozen=True)
class State:
    """The vehicle as fitted so far, the effects found in order, and the verdicts on all others.

    `terms` are those without a name; `removed` says why added effects were removed again; `refused` passed the gates of
    their scores but not the later ones, and are tried again only before the end; `tested` are exchanges of two that
    were tried; `trail` holds the values of fits by the effects that they had; `hidden` are the loads whose states were
    decoded.
    """

    fit: Calibration
    found: tuple[Found, ...] = ()
    terms: tuple[Term, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    absorbs: Mapping[str, list[str]] = field(default_factory=dict)
    removed: Mapping[str, Rejection] = field(default_factory=dict)
    refused: tuple[str, ...] = ()
    tested: tuple[str, ...] = ()
    trail: Mapping[str, list[float]] = field(default_factory=dict)
    finished: bool = False
    hidden: Hidden | None = None

    @property
    def barred(self) -> frozenset[str]:
        """What takes no place any more: removed twice, exchanged for another, or removed at the end."""
        return frozenset(id_ for id_, why in self.removed.items() if why.numbers.get("times", 2) > 1)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the found effects, in order."""
        return tuple(f.id for f in self.found)
