"""MATLAB 7.3, which is HDF5, and what of MATLAB's own objects is said."""

import struct
import sys
import tempfile
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from logs_helpers import samples

from hdev_jax.errors import InputError
from hdev_jax.logs import Adapter, Log, read_log

h5py = pytest.importorskip("h5py", reason="hdev_jax[formats] is not installed")
FRAME = samples(60).drop(columns="trip_id").round(3)


def write(path: Path, variables: dict[str, np.ndarray], classes: dict[str, str] | None = None) -> Path:
    """A file as MATLAB writes it with -v7.3: dimensions turned round, a class beside each variable."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, x in variables.items():
            kind = (classes or {}).get(name, "logical" if x.dtype == bool else "double")
            found = file.create_dataset(name, data=np.atleast_2d(x).T.astype("u1" if x.dtype == bool else x.dtype))
            found.attrs["MATLAB_class"] = np.bytes_(kind)
            if kind in ("timeseries", "timetable", "table"):
                found.attrs["MATLAB_object_decode"] = 3
        file.create_group("#refs#")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")
    return path


def read(variables: dict[str, np.ndarray], classes: dict[str, str] | None = None, adapter: dict | None = None) -> Log:
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder) / "drive.mat", variables, classes)
        return read_log(path, None if adapter is None else Adapter.from_dict(adapter))


@settings(max_examples=50)
@given(st.sampled_from(["row", "column"]), st.sampled_from(["f8", "f4"]), st.booleans(), st.booleans())
def test_vectors_are_columns(shape, kind, door, text):
    variables = {c: FRAME[c].to_numpy() for c in FRAME}
    variables["battery_power_w"] = variables["battery_power_w"].astype(kind)
    variables |= {"door_open": FRAME["time_s"].to_numpy() > 30.0} if door else {}
    variables = {c: x[:, None] if shape == "column" else x[None, :] for c, x in variables.items()}
    variables |= {"note": np.frombuffer(b"a note", np.uint8).astype("u2")} if text else {}
    log = read(variables, {"note": "char"})
    assert log.trip_names == ("drive",)
    np.testing.assert_allclose(log.segments.distance_m, FRAME["speed_mps"] * log.segments.duration_s)
    np.testing.assert_allclose(log.measured["battery_power_w"], FRAME["battery_power_w"], rtol=1e-6)
    assert log.segments.has("door_open") == door
    assert ("left out: note (char)" in "\n".join(log.ledger.lines())) == text


@settings(max_examples=50)
@given(st.sampled_from([0.1, 0.5, 2.0]), st.integers(1, 3))
def test_pairs_of_time_and_value(step, trips):
    variables = {}
    for k in range(trips):
        t, slow = np.arange(0.0, 60.0, step), np.arange(0.0, 61.0, 5.0)
        variables[f"Run{k}_V"] = np.c_[t, 36.0 + t + k]
        variables[f"Run{k}_T"] = np.c_[slow, 2.0 * slow]
    rules = {"speed_mps": {"source": "V", "unit": "km/h"}, "ambient_temp_c": "T"}
    log = read(variables, adapter={"layout": "time_value", "trip_id": "Run(\\d+)_", "columns": rules})
    assert log.trip_names == tuple(map(str, range(trips)))
    rows = np.asarray(log.segments.trip) == trips - 1
    t = np.arange(0.0, 60.0, step)
    np.testing.assert_allclose(np.asarray(log.segments.distance_m)[rows], (36.0 + t + trips - 1) / 3.6 * step)
    np.testing.assert_allclose(np.asarray(log.segments.channels["ambient_temp_c"])[rows], 2.0 * t)


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("timeseries", r"'run' is a timeseries.* t = run.Time; x = run.Data"),
        ("timetable", r"writetimetable\(run, 'log.csv'\)"),
        ("table", r"writetable\(run, 'log.csv'\)"),
    ],
)
def test_objects_of_matlab_say_how_to_export_them(tmp_path, kind, says):
    with pytest.raises(InputError, match=says):
        read_log(write(tmp_path / "x.mat", {"run": np.arange(4.0)}, {"run": kind}))
    (tmp_path / "y.mat").write_bytes(_opaque("run", kind))
    with pytest.raises(InputError, match=says):
        read_log(tmp_path / "y.mat")


def _opaque(name: str, kind: str) -> bytes:
    """A version 5 file with an object: flags, the variable's name, `MCOS`, the class, what it refers to."""

    def element(code: int, body: bytes) -> bytes:
        return struct.pack("<II", code, len(body)) + body + bytes(-len(body) % 8)

    words = b"".join(element(1, text.encode()) for text in (name, "MCOS", kind))
    matrix = element(14, element(6, struct.pack("<II", 17, 0)) + words)
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + matrix


def test_a_struct_of_version_5_says_how_to_export_it(tmp_path):
    scipy.io.savemat(tmp_path / "x.mat", {"run": {"speed_mps": np.ones(4)}})
    with pytest.raises(InputError, match=r"'run' is a struct.*writetable\(struct2table\(run\), 'log.csv'\)"):
        read_log(tmp_path / "x.mat")
    scipy.io.savemat(tmp_path / "y.mat", {c: FRAME[c].to_numpy() for c in FRAME} | {"sheet": "text"})
    assert "left out: sheet (char)" in "\n".join(read_log(tmp_path / "y.mat").ledger.lines())


def test_damaged_and_without_the_library(tmp_path, monkeypatch):
    path = write(tmp_path / "x.mat", {c: FRAME[c].to_numpy() for c in FRAME})
    data = path.read_bytes()
    for size in (600, len(data) // 2, len(data) - 100):
        (tmp_path / "cut.mat").write_bytes(data[:size])
        with pytest.raises(InputError, match=r"truncated or damaged MATLAB 7\.3"):
            read_log(tmp_path / "cut.mat")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"needs h5py: pip install 'hdev_jax\[formats\]'.*-v7"):
        read_log(path)
