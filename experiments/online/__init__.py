"""Estimates, forecasts and alarms while a vehicle drives, against synthetic truth."""

__all__ = []
