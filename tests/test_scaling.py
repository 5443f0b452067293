"""What the benchmark of long logs holds itself to."""

import sys
from pathlib import Path

import pytest


@pytest.fixture
def scaling(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import scaling

    yield scaling
    del sys.modules["scaling"]


def test_effects_are_counted_and_not_their_columns(scaling):
    one = {"rows": 10_000, "run_s": 1.0, "peak_gb": 1.0, "effects": 38, "columns": 208}
    assert scaling.missed([one]) == ["38 effects (208 columns), at least 40 expected"]
    assert scaling.missed([{**one, "effects": 41}]) == []
