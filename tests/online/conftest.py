"""A PostgreSQL server for the tests of the service."""

import tempfile
from pathlib import Path

import pytest
from servers import Postgres


@pytest.fixture(scope="session")
def postgres():
    with tempfile.TemporaryDirectory(
        prefix="hdev-postgres-"
    ) as folder:  # not among pytest's, which root alone may read
        Path(folder).chmod(0o755)
        server = Postgres(Path(folder))
        yield server
        server.stop()
