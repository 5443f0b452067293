"""The noise of a residual: its autocorrelation, the random intercepts of trips, its cycles."""

__all__ = []
