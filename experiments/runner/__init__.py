"""Running experiments: configs, tasks, workers, tables, pages."""

__all__ = []
