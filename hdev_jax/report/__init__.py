"""The report: one HTML page that opens offline, and its figures, from what a diagnosis or a calibration found."""

from hdev_jax.report.data import ReportData
from hdev_jax.report.page import write_calibration_report, write_report
from hdev_jax.report.words import answer

__all__ = ["ReportData", "answer", "write_calibration_report", "write_report"]
