"""Signals: recordings of buses and of measurement systems, read a channel at a time."""

from hdev_jax.logs.readers.signals.read import read_signals

__all__ = ["read_signals"]
