"""`--out DIR` is complete or absent: done, resumed, cleared or refused."""

import json
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from hdev_jax.errors import InputError
from hdev_jax.rundir import atomic_file, config_digest, open_run

CONFIG = {
    "verb": "diagnose",
    "logs": [Path("a.csv")],
    "fdr": 0.05,
    "target": None,
    "trips": ("1", "2"),
    "seed": np.int64(3),
}

# Computes stage one, then waits in stage two to be killed.
VICTIM = """
import signal, sys, time
from pathlib import Path
from hdev_jax.rundir import open_run
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
with open_run(sys.argv[1], {"verb": "demo"}) as run:
    run.checkpoint("one", lambda: {"value": 1})
    run.path("figures", "half.png").write_bytes(b"half")
    print("ready", flush=True)
    time.sleep(60)
"""


def boom():
    raise AssertionError("computed again")


def killed(out: Path, how: int = signal.SIGKILL) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", VICTIM, out], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as victim:
        assert victim.stdout is not None
        victim.stdout.readline()
        victim.send_signal(how)


@pytest.fixture
def out(tmp_path):
    return tmp_path / "result"


def test_a_run_appears_complete(out):
    with open_run(out, CONFIG, seed=3, command=["hdev", "diagnose", "a.csv"]) as run:
        assert not run.done
        run.path("figures", "f.png").write_bytes(b"png")
        run.checkpoint("fit", lambda: 1)
        assert not out.exists()
    assert sorted(p.name for p in out.iterdir()) == ["config.toml", "environment.json", "figures"]
    assert [p.name for p in out.parent.iterdir()] == ["result"]
    config = tomllib.loads((out / "config.toml").read_text())
    assert config.pop("hdev")["config_sha256"] == run.digest == config_digest(CONFIG)
    assert config == {"verb": "diagnose", "logs": ["a.csv"], "fdr": 0.05, "trips": ["1", "2"], "seed": 3}
    environment = json.loads((out / "environment.json").read_text())
    assert environment["command"] == ["hdev", "diagnose", "a.csv"]
    assert environment["seed"] == 3
    assert environment["seconds"] >= 0
    assert environment["packages"]["jax"]
    assert environment["files"] == ["config.toml", "environment.json", "figures/f.png"]


def test_the_same_configuration_is_done(out):
    with open_run(out, CONFIG) as run:
        run.path("answer.txt").write_text("42")
    with open_run(out, dict(reversed(CONFIG.items()))) as run:
        assert run.done
        assert run.path("answer.txt").read_text() == "42"
        with pytest.raises(ValueError, match="is complete"):
            run.checkpoint("fit", boom)


def test_an_error_in_a_done_run_stays_what_it_is(out):
    with open_run(out, CONFIG):
        pass
    with pytest.raises(FileNotFoundError), open_run(out, CONFIG) as run:
        run.path("absent.txt").read_text()


def test_another_configuration_is_refused(out):
    with open_run(out, CONFIG):
        pass
    for changed in ({**CONFIG, "fdr": 0.1}, {**CONFIG, "log_sha256": "other content, same name"}):
        with pytest.raises(InputError, match="another configuration"), open_run(out, changed):
            boom()
    assert sorted(p.name for p in out.iterdir()) == ["config.toml", "environment.json"]
    (out / "config.toml").write_text((out / "config.toml").read_text().replace("0.05", "0.06"))
    with pytest.raises(InputError, match="another configuration"), open_run(out, CONFIG):
        boom()


def test_a_done_folder_with_a_file_missing_is_not_done(out):
    with open_run(out, CONFIG) as run:
        run.path("report.html").write_text("x")
    (out / "report.html").unlink()
    with pytest.raises(InputError, match="files of it are missing"), open_run(out, CONFIG):
        boom()


@pytest.mark.parametrize("beside", ["", ".partial"])
def test_a_folder_with_other_files_is_left_alone(out, beside):
    folder = out.with_name(out.name + beside)
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="holds other files"), open_run(out, CONFIG):
        boom()
    assert [p.name for p in folder.iterdir()] == ["thesis.tex"]
    assert [p.name for p in out.parent.iterdir()] == [folder.name]


def test_an_empty_folder_is_used(out):
    out.mkdir()
    out.with_name("result.partial").mkdir()
    with open_run(out, CONFIG) as run:
        run.path("x").write_text("x")
    assert (out / "x").exists()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_killed_run_resumes(out, how):
    killed(out, how)
    assert not out.exists()
    with open_run(out, {"verb": "demo"}) as run:
        assert run.checkpoint("one", boom) == {"value": 1}
        assert run.checkpoint("two", lambda: 2) == 2
    assert not (out / "figures").exists(), "what was half-written is gone"
    assert json.loads((out / "environment.json").read_text())["resumed"]


def test_a_killed_run_of_another_configuration_is_cleared(out):
    killed(out)
    with open_run(out, {"verb": "other"}) as run:
        assert run.checkpoint("one", lambda: "fresh") == "fresh"
    assert not json.loads((out / "environment.json").read_text())["resumed"]


def test_two_processes_do_not_share_a_folder(out):
    with subprocess.Popen(
        [sys.executable, "-c", VICTIM, out], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as other:
        try:
            assert other.stdout is not None
            other.stdout.readline()
            with pytest.raises(InputError, match=f"process {other.pid}"), open_run(out, {"verb": "demo"}):
                boom()
        finally:
            other.kill()


def test_bad_input_leaves_nothing_and_an_exception_leaves_the_checkpoints(out):
    with pytest.raises(InputError, match="no such trip"), open_run(out, CONFIG) as run:
        run.checkpoint("one", lambda: 1)
        raise InputError("no such trip")
    assert not list(out.parent.iterdir())
    with pytest.raises(ZeroDivisionError), open_run(out, CONFIG) as run:
        run.checkpoint("one", lambda: 1)
        1 / 0
    with open_run(out, CONFIG) as run:
        assert run.checkpoint("one", boom) == 1


def test_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for place in ("file", "file/below"):
        with pytest.raises(InputError, match=r"--out .*: .*name a folder"), open_run(tmp_path / place, CONFIG):
            boom()
    with pytest.raises(InputError, match="cannot be written"), atomic_file(tmp_path / "file" / "below.csv"):
        boom()
    with pytest.raises(InputError, match="it is a folder"), atomic_file(tmp_path):
        boom()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="current folder"), open_run(".", CONFIG):
        boom()
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_folder_without_permission(out, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")  # root, who runs many a CI, may write anywhere

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(InputError, match="cannot be written \\(Permission denied\\)"), open_run(out, CONFIG):
        boom()


def test_a_file_appears_complete(tmp_path):
    path = tmp_path / "new" / "predicted.csv.gz"
    with pytest.raises(ZeroDivisionError), atomic_file(path) as temporary:
        temporary.write_text("half")
        1 / 0
    assert not list(path.parent.iterdir())
    with atomic_file(path) as temporary:
        assert temporary.name.endswith(path.name), "the ending tells pandas how to write it"
        temporary.write_text("whole")
    assert [p.read_text() for p in path.parent.iterdir()] == ["whole"]


def test_checkpoints_give_back_what_they_were_given(out):
    value = {
        "text": "ö",
        "numbers": [1, 0.1, -0.0, float("inf"), np.float64(0.3)],
        "pair": (1, (None, True)),
        "tags": {"a": 1, "d": {"t": [2]}},
        "array": np.arange(6.0).reshape(2, 3),
        "nested": [{"jax": jnp.ones(3), "flags": np.array([True, False]), "names": np.array(["x", "yy"])}],
    }
    with pytest.raises(ZeroDivisionError), open_run(out, CONFIG) as run:
        first = run.checkpoint("a", lambda: value)
        1 / 0
    with open_run(out, CONFIG) as run:
        again = run.checkpoint("a", boom)
    for got in (first, again):
        np.testing.assert_equal(got, value)
        assert got["pair"] == (1, (None, True))
        assert got["tags"] == value["tags"]
        assert got["array"].dtype == np.float64


@pytest.mark.parametrize("value", [object(), {1: 2}, {"x": {3, 4}}, np.array([object()])])
def test_a_checkpoint_refuses_what_it_cannot_give_back(out, value):
    with pytest.raises(TypeError, match="a checkpoint"), open_run(out, CONFIG) as run:
        run.checkpoint("a", lambda: value)


def test_a_damaged_checkpoint_is_computed_again(out):
    with open_run(out, CONFIG) as run:
        run.checkpoint("a", lambda: 1)
        run.path(".checkpoints", "a.npz").write_bytes(b"PK half")
        assert run.checkpoint("a", lambda: 2) == 2


@pytest.mark.parametrize("name", ["", "../x", "a b"])
def test_checkpoint_names(out, name):
    with pytest.raises(ValueError, match="named by"), open_run(out, CONFIG) as run:
        run.checkpoint(name, boom)


def test_configurations_hold_plain_values(out):
    with pytest.raises(TypeError, match="not object"), open_run(out, {"x": object()}):
        boom()
    with pytest.raises(ValueError, match="own"), open_run(out, {"hdev": 1}):
        boom()


def test_the_lock_goes_with_the_run(out):
    started = time.monotonic()
    for seed in range(3):
        with pytest.raises(ZeroDivisionError), open_run(out, {"seed": seed}):
            1 / 0
    assert time.monotonic() - started < 5
