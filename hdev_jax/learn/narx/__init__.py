"""NARX models of paper 2: network, fits in prediction and simulation, choices, recursive identification."""

__all__ = []
