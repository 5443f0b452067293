"""Prior, likelihood and posterior of each coefficient as curves: the table, the log, both."""

from typing import Any

import numpy as np

from hdev_jax.report import names
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, axis_label, figure, tidy
from hdev_jax.report.data import ReportData
from hdev_jax.report.words import number

__all__ = ["likelihood_of", "prior_likelihood_posterior"]

MOST = 9  # coefficients that are drawn; a fleet's vehicles are more than a figure holds


def likelihood_of(
    mean: np.ndarray, covariance: np.ndarray, prior: np.ndarray, prior_sd: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd `[k]` of the normal that times the prior is the posterior; an infinite sd where the log says nothing.

    In units of the prior, so that coefficients of all sizes are as well conditioned.
    """
    z, inside = (mean - prior) / prior_sd, covariance / np.outer(prior_sd, prior_sd)
    precision = np.linalg.inv(inside)
    own = precision - np.eye(len(mean))
    values, vectors = np.linalg.eigh(0.5 * (own + own.T))
    determined = values > 1e-6 * max(float(values[-1]), 1.0)
    inverse = np.where(determined, 1.0 / np.where(determined, values, 1.0), 0.0)
    centre = vectors @ (inverse * (vectors.T @ (precision @ z)))
    empty = np.sum(vectors[:, ~determined] ** 2, axis=1) > 1e-6
    sd = np.where(empty, np.inf, np.sqrt((vectors**2) @ inverse))
    return prior + prior_sd * centre, prior_sd * sd


def _curve(x: np.ndarray, mean: float, sd: float) -> np.ndarray:
    """A normal's density, its peak at 1."""
    return np.exp(-0.5 * ((x - mean) / sd) ** 2)


def prior_likelihood_posterior(data: ReportData) -> Any | None:
    """A panel for each coefficient that has a table; None where there is none, or no covariance."""
    parameters = data.summary.get("baseline", {}).get("parameters", {})
    block = data.summary.get("covariance", {})
    have = [k for k in block.get("names", []) if parameters.get(k, {}).get("prior_sd")]
    if not have:
        return None
    at = [block["names"].index(k) for k in have]
    covariance = np.atleast_2d(np.asarray(block["matrix"], dtype=float))[np.ix_(at, at)]
    mean, prior, prior_sd = (np.array([parameters[k][f] for k in have]) for f in ("value", "prior_value", "prior_sd"))
    centre, width = likelihood_of(mean, covariance, prior, prior_sd)
    have = have[:MOST]
    columns = min(len(have), 3)
    lines = -(-len(have) // columns)
    fig = figure(3.4 * columns, 2.3 * lines + 0.3)
    for j, name in enumerate(have):
        ax = fig.add_subplot(lines, columns, j + 1)
        sd = float(np.sqrt(covariance[j, j]))
        low = min(prior[j] - 3 * prior_sd[j], mean[j] - 4 * sd)
        high = max(prior[j] + 3 * prior_sd[j], mean[j] + 4 * sd)
        x = np.union1d(np.linspace(low, high, 400), mean[j] + sd * np.linspace(-4, 4, 81))
        ax.plot(x, _curve(x, prior[j], prior_sd[j]), color=GREY, linestyle="--", label="prior: the table")
        if np.isfinite(width[j]):
            x = np.union1d(x, np.clip(centre[j] + width[j] * np.linspace(-4, 4, 81), low, high))
            ax.plot(x, _curve(x, centre[j], width[j]), color=BEFORE, label="likelihood: the log")
        ax.plot(x, _curve(x, mean[j], sd), color=AFTER, linewidth=1.8, label="posterior")
        words, unit = names.coefficient(name)
        ax.set_xlabel(axis_label(words, parameters[name].get("unit") or unit))
        ax.set_yticks([])
        ax.locator_params(axis="x", nbins=4)
        least = 1e-6 * (high - low)  # a tick at 0 is not exactly there
        ax.xaxis.set_major_formatter(lambda v, _, least=least: number(v if abs(v) > least else 0.0, 2))
        tidy(ax, grid="x")
    handles, labels = fig.axes[0].get_legend_handles_labels()
    synthetic = "synthetic data" if data.synthetic else None
    fig.legend(handles, labels, loc="outside upper left", ncols=3, title=synthetic)
    return fig
