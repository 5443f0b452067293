"""The parameters of loads that switch, and of the errors about their levels."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from hdev_jax.inference.states.rows import StateRows
from hdev_jax.physics.states import COVARIATES, KNOTS_C

__all__ = ["LEAST_MEMORY_S", "MOST_MEMORY_S", "Switching", "kept_errors", "log_t", "scales"]

LEAST_MEMORY_S = 30.0  # contactors and compressors are not switched faster; what is faster counts as an error
MOST_MEMORY_S = 7200.0


@dataclass(frozen=True)
class Switching:
    """Parameters of on/off loads: the power of each [W], what is left with all off [W], the scale of the errors'
    innovations in motion and at standstill [W] (where energies are measured: in a row of `USUAL_S`), each load's share
    of time on at `KNOTS_C` and its memory [s]; the memory of the errors [s], 0 where they are independent, and the
    degrees of freedom of their innovations; the log-odds of being on by each of `COVARIATES`."""

    power_w: Float[np.ndarray, " load"]
    base_w: float
    scale_w: Float[np.ndarray, " kind"]
    share: Float[np.ndarray, "load knot"]
    memory_s: Float[np.ndarray, " load"]
    error_s: float = 0.0
    freedom: float = 4.0
    by: Float[np.ndarray, "load covariate"] = field(default_factory=lambda: np.zeros((0, len(COVARIATES))))

    def __post_init__(self) -> None:
        if not len(self.by):
            object.__setattr__(self, "by", np.zeros((len(self.power_w), len(COVARIATES))))

    @property
    def on(self) -> Float[np.ndarray, "state load"]:
        """Which loads are on in each joint state."""
        return np.array(list(itertools.product((0.0, 1.0), repeat=len(self.power_w))))

    def plus(self, other: "Switching") -> "Switching":
        """These loads with those of another model; the other's base and scales."""
        return Switching(
            np.r_[self.power_w, other.power_w], other.base_w, other.scale_w, np.r_[self.share, other.share],
            np.r_[self.memory_s, other.memory_s], other.error_s, other.freedom, np.r_[self.by, other.by],
        )  # fmt: skip

    def only(self, kept: Sequence[int]) -> "Switching":
        """Some of these loads."""
        at = list(kept)
        power, share, memory, by = (x[at] for x in (self.power_w, self.share, self.memory_s, self.by))
        return replace(self, power_w=power, share=share, memory_s=memory, by=by)

    def turned(self) -> "Switching":
        """The same levels with on and off exchanged."""
        base = self.base_w + float(np.sum(self.power_w))
        return replace(self, power_w=-self.power_w, base_w=base, share=1.0 - self.share, by=-self.by)

    def expected(self, rows: StateRows) -> Float[np.ndarray, "row load"]:
        """Share of time on in each row, without measured power; as `expected_share` of the effect."""
        share = np.stack([np.interp(rows.temp_c, KNOTS_C, s) for s in self.share], axis=1)
        if not np.any(self.by):
            return share
        odds = np.exp(rows.beside @ self.by.T)
        return share * odds / (share * odds + 1.0 - share)

    def predicted_w(self, on: Float[np.ndarray, "row load"]) -> Float[np.ndarray, " row"]:
        """Base and loads [W] for a share of time on in each row."""
        return self.base_w + on @ self.power_w


def kept_errors(model: Switching, rows: StateRows, starts: np.ndarray) -> Float[np.ndarray, " row"]:
    """How much of the error of the row before a row's error keeps [W/W]; none of it in a trip's first row."""
    kept = np.exp(-rows.forgets_s / max(model.error_s, 1e-9)) * rows.wide / np.r_[1.0, rows.wide[:-1]]
    kept[starts] = 0.0
    return kept


def scales(model: Switching, rows: StateRows, starts: np.ndarray) -> Float[np.ndarray, " row"]:
    """Scale of each row's error given the row before [W]; of a trip's first row, which has none, of all its errors."""
    out = model.scale_w[rows.standing] * rows.wide
    out[starts] /= np.sqrt(-np.expm1(-2.0 * rows.forgets_s[starts] / max(model.error_s, 1e-9)))
    return out


def log_t(x: Any, freedom: float) -> Any:
    """Logarithm of Student's density."""
    norm = gammaln(0.5 * (freedom + 1.0)) - gammaln(0.5 * freedom) - 0.5 * np.log(freedom * np.pi)
    return norm - 0.5 * (freedom + 1.0) * np.log1p(np.square(x) / freedom)
