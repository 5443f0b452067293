"""The page of a simulated fleet and its figures."""

from hdev_jax.report.fleet.page import fleet_summary, fleet_text, write_fleet_report

__all__ = ["fleet_summary", "fleet_text", "write_fleet_report"]
