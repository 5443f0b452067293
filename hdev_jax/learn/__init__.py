"""Learning from logs: sequence models of paper 2, and what they are compared with."""

from hdev_jax.learn.narx.levenberg import Fitted, NormalLevenbergMarquardt, fit_many
from hdev_jax.learn.narx.model import Narx, Structure, fit_prediction, fit_simulation, prepared, starts, with_theta
from hdev_jax.learn.narx.network import Shape
from hdev_jax.learn.sequences import Scale, Trip, lagged, trips_of
from hdev_jax.learn.sources import Channels, KernelTerms

__all__ = [
    "Channels",
    "Fitted",
    "KernelTerms",
    "Narx",
    "NormalLevenbergMarquardt",
    "Scale",
    "Shape",
    "Structure",
    "Trip",
    "fit_many",
    "fit_prediction",
    "fit_simulation",
    "lagged",
    "prepared",
    "starts",
    "trips_of",
    "with_theta",
]
