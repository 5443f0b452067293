"""Studies of calibration: coverage, ranks, linearity, mass, efficiency maps."""

__all__ = []
