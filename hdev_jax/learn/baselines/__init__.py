"""What the papers compare with: classical regressors and recurrent networks."""

__all__ = []
