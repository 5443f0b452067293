"""The journal in PostgreSQL: what it is given and what it says; the service's tests cover what it keeps, in both."""

from pathlib import Path

import numpy as np
import pytest
from servers import PASSWORD, free_port

from hdev_jax import cli, progress
from hdev_jax.errors import InputError
from hdev_jax.fleet import demo_log
from hdev_jax.online.service import Journal, UnavailableError
from hdev_jax.online.service.journal import Kept, Sent, postgresql


def rows(*times, vehicle="V", **body):
    return [(vehicle, "T", t, body) for t in times]


@pytest.fixture(params=["sqlite", "postgresql"])
def journal(request, tmp_path):
    place = tmp_path / "s" if request.param == "sqlite" else request.getfixturevalue("postgres").database()
    journal = Journal(place)
    yield journal
    journal.close()


def test_what_is_put_is_there_in_its_order_and_once(journal):
    odd = 0.1 + 0.2
    new = journal.put("f", [*rows(3.0, 1.0, odd, a=1.5), *rows(3.0, odd, a=2), *rows(-0.0, 0.0, vehicle="'; DROP --")])
    assert [(name, s.time_s, s.body) for name, s in new] == [
        ("V", 3.0, {"a": 1.5}), ("V", 1.0, {"a": 1.5}), ("V", odd, {"a": 1.5}), ("'; DROP --", 0.0, {})
    ]  # fmt: skip
    assert [s.seq for _, s in new] == sorted({s.seq for _, s in new})
    assert journal.put("f", rows(1.0, 3.0)) == []
    assert journal.put("other", rows(1.0)) != []
    assert journal.put("f", []) == []
    assert sorted(journal.vehicles()) == [("f", "'; DROP --"), ("f", "V"), ("other", "V")]
    first, _, third = (s.seq for _, s in new[:3])
    assert [*journal.since("f", "V", third - 1, [first])] == [Sent(first, "T", 3.0, {"a": 1.5}), new[2][1]]
    assert journal.kept("f", "V") is None
    for upto in (1, 2):
        journal.keep([("f", "V", Kept(upto, {"x": None}, np.arange(3.0))), ("f", "W", Kept(upto, {}, None))])
    kept = journal.kept("f", "V")
    assert kept is not None
    assert kept[:2] == (2, {"x": None})
    np.testing.assert_array_equal(kept.numbers, np.arange(3.0))


def refused(place) -> str:
    with pytest.raises(InputError) as e:
        Journal(place).close()
    assert not any(part in str(e.value) for part in ("s3cret", "w0rd", "geheim"))
    return str(e.value)


def test_what_is_no_database_of_it_is_one_line_without_a_password(postgres, tmp_path, capsys):
    url = postgres.database()
    assert "password authentication failed" in refused(url.replace("s3cret", "other"))
    assert 'database "none" does not exist' in refused(postgres.url("none"))
    for wrong in ("s3/cret", "s3@cret", "s3%cret"):
        assert "%40 for @ and %2F for /" in refused(url.replace("s3cret", wrong))
    for wrong in ("mysql://u:geheim@h/d", "postgresql:u:geheim@h/d", Path(url)):
        assert refused(wrong).endswith("a file is expected, or postgresql://… as text")
    postgres.run("CREATE TABLE rows (a INTEGER)", url.rsplit("/", 1)[1])
    assert 'no database of hdev serve (column "fleet" does not exist)' in refused(url)
    assert "in LATIN1" in refused(postgres.database("ENCODING 'LATIN1' TEMPLATE template0"))
    away = f"postgresql://u:geheim@127.0.0.1:{free_port()}/d"
    assert "cannot be reached" in refused(away)
    demo_log(3, trips=1).write(tmp_path, truth=False)
    assert cli.main(["serve", "--sheets", str(tmp_path), "--state", away, "--port", "0"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "cannot be reached" in said
    assert "geheim" not in said


def test_each_process_may_have_a_schema_of_its_own_and_another_version_is_refused(postgres):
    url = postgres.database()
    name = url.rsplit("/", 1)[1]
    postgres.run("CREATE SCHEMA north", name)
    north, south = Journal(f"{url}?options=-csearch_path%3Dnorth"), Journal(url)
    north.put("f", rows(1.0))
    assert (north.vehicles(), south.vehicles()) == ([("f", "V")], [])
    north.close()
    south.close()
    postgres.run("UPDATE north.journal SET version = 9", name)
    assert "of another version (9)" in refused(f"{url}?options=-csearch_path%3Dnorth")


def test_a_server_that_goes_is_told_once_and_reached_again(postgres, monkeypatch):
    journal, said = Journal(postgres.database()), []
    monkeypatch.setattr(postgresql, "RETRY_S", 0.0)
    monkeypatch.setattr(progress, "step", said.append)
    postgres.stop()
    for time_s in (1.0, 2.0):
        with pytest.raises(UnavailableError):
            journal.put("f", rows(time_s))
    postgres.start()
    assert len(journal.put("f", rows(2.0))) == 1
    assert len(said) == 2, said
    assert said[0].endswith("rows are answered by 503 until that is over")
    assert said[1].endswith("rows are kept again")
    assert PASSWORD.split()[0] not in "".join(said)
    postgres.stop()
    postgres.start()
    assert len(journal.put("f", rows(3.0))) == 1, "nobody asked meanwhile: it is not even noticed"
    journal.close()
