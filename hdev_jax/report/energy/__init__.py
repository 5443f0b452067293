"""Pages of answers about energy: one template, sections of tables and figures."""

from hdev_jax.report.energy.page import Page, Section, Table, write_energy_page

__all__ = ["Page", "Section", "Table", "write_energy_page"]
