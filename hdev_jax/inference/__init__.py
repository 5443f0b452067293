"""Estimators on top of the kernel: one parameter table, calibration, clusters, the closed form."""

from hdev_jax.inference.calibrate import Calibration, calibrate, jacobian, linearised, predict
from hdev_jax.inference.clusters import Clusters, cluster_rows, clusters_of
from hdev_jax.inference.design import LinearFit, Rows, design, linear_fit
from hdev_jax.inference.identified import caveats
from hdev_jax.inference.linear import (
    Posterior,
    Prior,
    Statistics,
    follow,
    least_squares,
    statistics,
    update,
)
from hdev_jax.inference.parameters import Coefficient, ParameterTable, effect_coefficients, insert, insert_by
from hdev_jax.inference.predictive import Spread, covariance_root, left_out, spread_of, sums_of
from hdev_jax.inference.rows import CHUNK_ROWS, Chunk, Fit, Shapes, chunks_of, chunks_of_fit, padded, padded_rows

__all__ = [
    "CHUNK_ROWS",
    "Calibration",
    "Chunk",
    "Clusters",
    "Coefficient",
    "Fit",
    "LinearFit",
    "ParameterTable",
    "Posterior",
    "Prior",
    "Rows",
    "Shapes",
    "Spread",
    "Statistics",
    "calibrate",
    "caveats",
    "chunks_of",
    "chunks_of_fit",
    "cluster_rows",
    "clusters_of",
    "covariance_root",
    "design",
    "effect_coefficients",
    "follow",
    "insert",
    "insert_by",
    "jacobian",
    "least_squares",
    "left_out",
    "linear_fit",
    "linearised",
    "padded",
    "padded_rows",
    "predict",
    "spread_of",
    "statistics",
    "sums_of",
    "update",
]
