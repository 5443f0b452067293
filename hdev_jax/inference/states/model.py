"""The parameters of loads that switch, and of the errors about their levels."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from hdev_jax.inference.states.rows import StateRows
from hdev_jax.physics.states import KNOTS_C

__all__ = ["Switching", "kept_errors", "log_t"]


@dataclass(frozen=True)
class Switching:
    """Parameters of on/off loads: the power of each [W], what is left with all off [W], the scale of the errors'
    innovations in motion and at standstill [W], each load's share of time on at `KNOTS_C` and its memory [s]; the
    memory of the errors [s], 0 where they are independent, and the degrees of freedom of their innovations."""

    power_w: Float[np.ndarray, " load"]
    base_w: float
    scale_w: Float[np.ndarray, " kind"]
    share: Float[np.ndarray, "load knot"]
    memory_s: Float[np.ndarray, " load"]
    error_s: float = 0.0
    freedom: float = 4.0

    @property
    def on(self) -> Float[np.ndarray, "state load"]:
        """Which loads are on in each joint state."""
        return np.array(list(itertools.product((0.0, 1.0), repeat=len(self.power_w))))

    def plus(self, other: "Switching") -> "Switching":
        """These loads with those of another model; the other's base and scales."""
        return Switching(
            np.r_[self.power_w, other.power_w], other.base_w, other.scale_w, np.r_[self.share, other.share],
            np.r_[self.memory_s, other.memory_s], other.error_s, other.freedom,
        )  # fmt: skip

    def only(self, kept: Sequence[int]) -> "Switching":
        """Some of these loads."""
        at = list(kept)
        return replace(self, power_w=self.power_w[at], share=self.share[at], memory_s=self.memory_s[at])

    def turned(self) -> "Switching":
        """The same levels with on and off exchanged."""
        return replace(
            self, power_w=-self.power_w, base_w=self.base_w + float(np.sum(self.power_w)), share=1.0 - self.share
        )

    def expected(self, temp_c: Float[np.ndarray, " row"]) -> Float[np.ndarray, "row load"]:
        """Share of time on in each row, without measured power."""
        return np.stack([np.interp(temp_c, KNOTS_C, s) for s in self.share], axis=1)

    def predicted_w(self, on: Float[np.ndarray, "row load"]) -> Float[np.ndarray, " row"]:
        """Base and loads [W] for a share of time on in each row."""
        return self.base_w + on @ self.power_w


def kept_errors(model: Switching, rows: StateRows, starts: np.ndarray) -> Float[np.ndarray, " row"]:
    """How much of the error of the row before a row's error keeps; none of it in a trip's first row."""
    kept = np.exp(-rows.duration_s / max(model.error_s, 1e-9))
    kept[starts] = 0.0
    return kept


def log_t(x: Any, freedom: float) -> Any:
    """Logarithm of Student's density."""
    norm = gammaln(0.5 * (freedom + 1.0)) - gammaln(0.5 * freedom) - 0.5 * np.log(freedom * np.pi)
    return norm - 0.5 * (freedom + 1.0) * np.log1p(np.square(x) / freedom)
