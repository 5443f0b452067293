"""Draws of a posterior: how well they were made (R-hat, effective draws, divergences), and on disk for ArviZ."""

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hdev_jax.errors import InputError

__all__ = ["ENOUGH_DRAWS", "MOST_R_HAT", "Draws", "needs"]

MOST_R_HAT = 1.01  # Vehtari, Gelman, Simpson, Carpenter and Bürkner, Bayesian Analysis 16 (2021)
ENOUGH_DRAWS = 400  # effective ones, of bulk and tail: the same paper, 100 for each of four chains
MOST_DIVERGENCES = 0.005  # of all draws


def needs(name: str) -> ModuleType:
    """A package of the extra `nuts`. Raises `InputError` where it is not installed."""
    import importlib

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # ArviZ announces its next version at every import
            return importlib.import_module(name)
    except ImportError as e:
        raise InputError(f"{name} is not installed; pip install 'hdev_jax[nuts]' for posteriors by sampling") from e


@dataclass(frozen=True)
class Draws:
    """Posterior draws `[chain, draw, …]` by name, and the names of their further axes.

    `how` says in a sentence how they were made: from which statistics, or by which sampler on the full likelihood.
    `steps`, the leapfrog steps of each draw where a sampler took any, and `diverging`, whether it diverged.
    """

    values: dict[str, Float[np.ndarray, "chain draw ..."]]
    how: str
    axes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    labels: dict[str, list[str]] = field(default_factory=dict)
    diverging: Bool[np.ndarray, "chain draw"] | None = None
    steps: Float[np.ndarray, "chain draw"] | None = None

    @property
    def divergent(self) -> int:
        """How many transitions diverged."""
        return 0 if self.diverging is None else int(np.sum(self.diverging))

    def flat(self, name: str) -> Float[np.ndarray, "draw ..."]:
        """All chains behind each other."""
        v = self.values[name]
        return v.reshape(-1, *v.shape[2:])

    def idata(self) -> Any:
        """The same as ArviZ's `InferenceData`."""
        az = needs("arviz")
        stats = {k: v for k, v in {"n_steps": self.steps, "diverging": self.diverging}.items() if v is not None}
        return az.from_dict(
            posterior=self.values, dims={k: list(v) for k, v in self.axes.items()}, coords=self.labels,
            **({"sample_stats": stats} if stats else {}),
        )  # fmt: skip

    def quality(self) -> dict[str, float]:
        """`r_hat` (largest), `ess` (smallest, of bulk and tail), `divergent` and `draws`, over all coefficients.

        As in Vehtari et al. (2021): rank-normalised and split.
        """
        az = needs("arviz")
        r_hats, bulk, tail = [1.0], [], []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a coefficient that does not vary has no R-hat
            for v in self.values.values():
                for column in v.reshape(*v.shape[:2], -1).transpose(2, 0, 1):
                    if np.ptp(column) == 0:
                        continue
                    r_hats.append(float(az.rhat(column)))
                    bulk.append(float(az.ess(column, method="bulk")))
                    tail.append(float(az.ess(column, method="tail")))
        chains, draws = next(iter(self.values.values())).shape[:2]
        # NaN where one of them has none, which min and max would pass over
        r_hat, ess, ess_bulk = np.max(r_hats), np.min([*bulk, *tail] or [0.0]), np.min(bulk or [0.0])
        return {
            "r_hat": float(r_hat), "ess": float(ess), "ess_bulk": float(ess_bulk), "divergent": self.divergent,
            "draws": chains * draws, "chains": chains,
        }  # fmt: skip

    def faults(self) -> list[str]:
        """Why these draws are no answer; none where they are one."""
        q, out = self.quality(), []
        if not all(np.all(np.isfinite(v)) for v in self.values.values()):
            out.append("draws are not finite")
        if q["chains"] < 2:
            out.append("one chain cannot be compared with another: at least two are expected")
        if not q["r_hat"] <= MOST_R_HAT:
            out.append(f"the chains disagree: R-hat {q['r_hat']:.3f}, at most {MOST_R_HAT} expected")
        if not q["ess"] >= ENOUGH_DRAWS:
            out.append(f"too few effective draws: {q['ess']:.0f}, at least {ENOUGH_DRAWS} expected")
        if q["divergent"] > MOST_DIVERGENCES * q["draws"]:
            out.append(f"{q['divergent']} of {q['draws']:.0f} transitions diverged: the posterior is not explored")
        return out

    def write(self, path: str | Path) -> None:
        """A NetCDF file that ArviZ reads."""
        data = self.idata()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data.to_netcdf(str(path), engine="h5netcdf")
