"""Estimators on top of the kernel: one parameter table, calibration, clusters."""

from hdev_jax.inference.calibrate import Calibration, Fit, calibrate, jacobian, padded, padded_rows, predict
from hdev_jax.inference.clusters import Clusters, cluster_rows, clusters_of
from hdev_jax.inference.parameters import Coefficient, ParameterTable, effect_coefficients, insert

__all__ = [
    "Calibration",
    "Clusters",
    "Coefficient",
    "Fit",
    "ParameterTable",
    "calibrate",
    "cluster_rows",
    "clusters_of",
    "effect_coefficients",
    "insert",
    "jacobian",
    "padded",
    "padded_rows",
    "predict",
]
