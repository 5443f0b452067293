"""Configurations and vehicles for the tests of the networks' experiment."""

from experiments.pinn.data import load
from experiments.pinn.study import Config
from experiments.runner.config import CONFIGS, resolve, typed

HELD = "tractor_6x2_44t"  # of twelve speeds, as A: what is compiled is shared


def tractors(*held, routes=24, share=1.0):
    """A and another tractor."""
    return load("fleet", 3, routes, held, share, None, 0, ("A", HELD))


def config(name, *sets):
    return typed(Config, resolve(CONFIGS / f"{name}.toml", sets), name)
