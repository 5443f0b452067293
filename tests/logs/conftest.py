"""Logs are filtered in fewer lanes at a time than a long log has: those without readings take as long as the others."""

import pytest

from hdev_jax.logs.instruments import smoother


@pytest.fixture(autouse=True)
def _lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(smoother, "SOME", 6)
    monkeypatch.setattr(smoother, "BATCH", 12)
