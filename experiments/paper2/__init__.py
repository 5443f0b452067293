"""Paper 2 on its own data: tables II to X and figures 4 to 13."""

__all__ = []
