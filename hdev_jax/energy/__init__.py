"""Answers about energy from a calibrated vehicle: where it goes, its road load, what a change costs or saved."""

__all__ = []
