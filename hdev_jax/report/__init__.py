"""The report: one HTML page that opens offline, and its figures, from what a diagnosis or a calibration found."""

__all__ = []
