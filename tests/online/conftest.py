"""A PostgreSQL server for the tests of the service."""

import pytest
from servers import Postgres


@pytest.fixture(scope="session")
def postgres(tmp_path_factory):
    folder = tmp_path_factory.mktemp("postgres")
    folder.chmod(0o755)
    for above in (folder.parent, folder.parent.parent):  # it runs as another user than root
        above.chmod(above.stat().st_mode | 0o011)
    server = Postgres(folder)
    yield server
    server.stop()
