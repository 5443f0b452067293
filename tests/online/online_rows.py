"""A truck whose model is linear in its coefficients, its rows as vectors, and the same posterior in one dense solve."""

import inference_rows as ir
import numpy as np

from hdev_jax.inference.sheet import Sheet
from hdev_jax.online import Form, State, start
from hdev_jax.segments import Segments

CHANNELS = ("mass_kg", "grade_rad")
NOISE_KW = 4.0


def sheet(**sections) -> Sheet:
    """The truck of `inference_rows`, as a sheet."""
    road = {"c_rr": (ir.C_RR, ir.C_RR_SD), "cda_m2": (ir.CDA, ir.CDA_SD)}
    return Sheet(
        **{"name": "truck", "mass_kg": 24e3, "road": road, "driveline": {"efficiency": ir.EFFICIENCY}} | sections
    )


def begun(**options) -> State:
    """The state before the first row, its target the battery's power, of a known noise that is white."""
    usual = {"memories": (0.0,), "levels": False, "robust": False, "noise": NOISE_KW}
    return start(options.pop("sheet", sheet()), CHANNELS, "battery_power_kw", **usual | options)[0]


def vectors(form: Form, segments: Segments, measured: np.ndarray) -> np.ndarray:
    """Rows `[row, column]` as `update` takes them."""
    columns = {"measured": measured, **segments.channels}
    return np.stack([np.asarray(columns.get(c, getattr(segments, c, None)), dtype=float) for c in form.columns], axis=1)


def drive(*lengths: int, seed: int = 0, rho: float = 0.0, truth=(0.0068, 5.2), noise: float = NOISE_KW):
    """Trips with known coefficients: segments, and power measured with a noise of that correlation."""
    rng = np.random.default_rng(seed)
    s = ir.driving(*lengths, seed=seed)
    white, e = rng.normal(size=len(s)) * noise, np.zeros(len(s))
    first = np.r_[True, np.diff(np.asarray(s.trip)) != 0]
    for i in range(len(s)):
        e[i] = white[i] / np.sqrt(1 - rho**2) if first[i] else rho * e[i - 1] + white[i]
    return s, ir.power_kw(s, np.array(truth)) + e


def dense(x: np.ndarray, r: np.ndarray, precision: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Generalised least squares with a Gaussian prior about 0, in one solve: mean and covariance."""
    weighed = np.linalg.solve(covariance, x)
    post = np.linalg.inv(np.diag(precision) + x.T @ weighed)
    return post @ (weighed.T @ r), post
