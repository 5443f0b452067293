"""Instruments: the noise and the step of what was read, the slope as far as its readings tell it."""

from hdev_jax.logs.instruments.instrument import Instrument, instruments_of
from hdev_jax.logs.instruments.places import metres
from hdev_jax.logs.instruments.slope import Slope, slope_of
from hdev_jax.logs.instruments.speed import end_speeds, speed_of
from hdev_jax.logs.instruments.steps import step_of

__all__ = ["Instrument", "Slope", "end_speeds", "instruments_of", "metres", "slope_of", "speed_of", "step_of"]
