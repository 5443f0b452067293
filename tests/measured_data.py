"""The folder of measured data: tests that read it are skipped without it, and in CI must run where it is."""

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("HDEV_DATA") or Path(__file__).parents[2] / "shared" / "data")
NO_DATA = f"no measured data in {DATA} (HDEV_DATA)"


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of measured data; the test is skipped where there is none."""
    if not DATA.is_dir():
        pytest.skip(NO_DATA)
    return DATA


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "data_dir" in getattr(item, "fixturenames", ()):
            item.add_marker("data")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item):
    """In CI, with the measured data there, a test that reads it must run: its skip is a failure."""
    report = yield
    skipped = report.skipped and not hasattr(report, "wasxfail")
    if skipped and "data" in item.keywords and os.environ.get("CI", "").lower() == "true" and DATA.is_dir():
        report.outcome = "failed"
        report.longrepr = f"skipped although the measured data is in {DATA}: {report.longrepr}"
    return report
