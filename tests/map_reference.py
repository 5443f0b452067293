"""The efficiency map by SciPy: monotone cubics along both axes of a gear's grid, blended. Shares no code with ours."""

import numpy as np
from scipy.interpolate import PchipInterpolator

__all__ = ["map_by_scipy"]


def map_by_scipy(speeds: np.ndarray, torques: np.ndarray, values: np.ndarray, w: float, t: float) -> float:
    """Efficiency at one point of one gear, `values` [speed, torque]; beyond the edges that of the edge.

    A bicubic Hermite patch without twist is the sum of the curves along its two pairs of edges, each blended by the
    cubic step, less the blended corners (Coons).
    """
    w, t = np.clip(w, speeds[0], speeds[-1]), np.clip(t, torques[0], torques[-1])
    i = min(max(int(np.searchsorted(speeds, w, side="right")) - 1, 0), len(speeds) - 2)
    j = min(max(int(np.searchsorted(torques, t, side="right")) - 1, 0), len(torques) - 2)
    a, b = (w - speeds[i]) / (speeds[i + 1] - speeds[i]), (t - torques[j]) / (torques[j + 1] - torques[j])
    by_a, by_b = (np.array([1 - x * x * (3 - 2 * x), x * x * (3 - 2 * x)]) for x in (a, b))
    along_speed = np.array([PchipInterpolator(speeds, values[:, j + n])(w) for n in (0, 1)])
    along_torque = np.array([PchipInterpolator(torques, values[i + m])(t) for m in (0, 1)])
    return float(along_speed @ by_b + along_torque @ by_a - by_a @ values[i : i + 2, j : j + 2] @ by_b)
