"""Recordings of buses and of measurement systems: made by the libraries that read them, read as the signals that went
in; what is left out is counted, what is damaged is refused."""

import sys
import tempfile
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from hdev_jax.errors import InputError
from hdev_jax.logs import Adapter, Log, read_log, write_adapter_skeleton
from hdev_jax.logs.readers.signals.bits import physical
from hdev_jax.logs.readers.signals.database import FMS

can = pytest.importorskip("can", reason="hdev_jax[can] is not installed")
cantools = pytest.importorskip("cantools", reason="hdev_jax[can] is not installed")
asammdf = pytest.importorskip("asammdf", reason="hdev_jax[can] is not installed")
pytestmark = pytest.mark.filterwarnings("ignore")  # asammdf and numexpr have their own

TRUCK = cantools.database.load_file(FMS)
N = 200
T = 0.1 * np.arange(N)
V = 40.0 + 10.0 * np.sin(T / 4.0)  # km/h
AMPS = 100.0 + 50.0 * np.sin(T / 3.0)
DBC = """VERSION ""
BU_: X
BO_ 291 Drive: 8 X
 SG_ Speed : 7|16@0+ (0.01,0) [0|250] "km/h" X
 SG_ Power : 16|16@1- (0.05,0) [-1000|1000] "kW" X
 SG_ Mode : 32|4@1+ (1,0) [0|15] "" X
BO_ 292 Extra: 8 X
 SG_ Which M : 0|8@1+ (1,0) [0|255] "" X
 SG_ Cabin m1 : 8|8@1+ (0.5,-40) [-40|80] "degC" X
 SG_ Outside m2 : 8|8@1+ (0.5,-40) [-40|80] "degC" X
VAL_ 291 Speed 65535 "SNA" ;
"""
RULES = {"speed_mps": "Speed", "battery_power_w": "Power", "ambient_temp_c": "Outside", "mode": "Mode"}


def frame(name: str, time: float, sender: int = 0, **values: float):
    m = TRUCK.get_message_by_name(name)
    absent = {s.name: (1 << s.length) - 1 for s in m.signals if s.multiplexer_ids is None}
    given_ = {k: round((v - (s := m.get_signal_by_name(k)).offset) / s.scale) for k, v in values.items()}
    data = m.encode(absent | given_, scaling=False, strict=False)
    return can.Message(timestamp=time, arbitration_id=m.frame_id & ~0xFF | sender, data=data)


def drive(sender: int = 0) -> list:
    """A truck's frames: speed and current ten times a second, weight and axle loads every second."""
    frames = []
    for k in range(N):
        frames.append(frame("CCVS1", T[k], sender, WheelBasedVehicleSpeed=V[k]))
        frames.append(frame("HVESSD1", T[k] + 0.002, 0x5B, HVESSVoltageLevel=600.0, HVESSCurrent=AMPS[k]))
        if k % 10 == 0:
            axle = (k // 10) % 2
            frames.append(frame("CVW", T[k] + 0.004, 0x0B, GrossCombinationVehicleWeight=34000.0))
            load = {f"Axle{axle + 1}Weight": 7000.0 + 1000.0 * axle}
            frames.append(frame("VW", T[k] + 0.006, 0x0B, AxleNumber=axle, **load))
            frames.append(can.Message(timestamp=T[k] + 0.008, arbitration_id=0x7, is_extended_id=False, data=b"ab"))
    return frames


def write(path: Path, frames: list) -> Path:
    with can.Logger(path) as logger:
        for f in frames:
            logger(f)
    return path


def own(folder: Path, name: str = "x.blf", speed: np.ndarray = V, **rules: object) -> tuple[Path, Adapter]:
    """Frames of a database of one's own, and an adapter that names it."""
    (folder / "own.dbc").write_text(DBC)
    db = cantools.database.load_string(DBC)
    frames = []
    for k in range(N):
        raw = {"Speed": 65535 if np.isnan(speed[k]) else speed[k], "Power": 3.0 * k - 100.0, "Mode": k // 100}
        data = db.encode_message("Drive", raw if not np.isnan(speed[k]) else raw | {"Speed": 655.35}, strict=False)
        frames.append(can.Message(timestamp=T[k], arbitration_id=291, is_extended_id=False, data=data))
        which = {"Which": 1, "Cabin": 21.0} if k % 2 else {"Which": 2, "Outside": -5.0}
        data = db.encode_message("Extra", which)
        frames.append(can.Message(timestamp=T[k] + 1e-3, arbitration_id=292, is_extended_id=False, data=data))
    (folder / "a.toml").write_text(
        'dbc = "own.dbc"\n[columns]\n' + "".join(f'{k} = "{v}"\n' for k, v in {**RULES, **rules}.items())
    )
    return write(folder / name, frames), Adapter.load(folder / "a.toml")


def said(log: Log) -> str:
    return "\n".join(log.ledger.lines())


@pytest.mark.parametrize("ending", ["blf", "asc", "mf4"])
def test_a_truck_by_the_numbers_of_its_parameters(tmp_path, ending):
    log = read_log(write(tmp_path / f"x.{ending}", drive()))
    np.testing.assert_allclose(log.segments.distance_m[5:-5], V[5:-6] / 36.0, rtol=2e-3)
    np.testing.assert_allclose(log.measured["battery_power_w"][5:-5], 600.0 * AMPS[5:-6], rtol=1e-3)
    c = log.segments.channels
    assert set(np.unique(c["mass_kg"])) == {34000.0}
    assert (c["axle_1_load_kg"][0], c["axle_2_load_kg"][-1]) == (7000.0, 8000.0)
    assert "read by the preset of that name" in said(log)
    assert "left out: 20 (identifiers: 1)" in said(log)


def test_a_second_sender_is_left_out_and_counted(tmp_path):
    """The one with the most values counts, not the one with the most frames: these say 'not available'."""
    absent = [frame("CCVS1", t + 0.01 + d, 0x31) for t in T for d in (0.0, 0.03)]
    other = [frame("CCVS1", t + 0.02, 0x17, WheelBasedVehicleSpeed=5.0) for t in T[::10]]
    frames = sorted(drive() + absent + other, key=lambda f: f.timestamp)
    log = read_log(write(tmp_path / "x.blf", frames))
    np.testing.assert_allclose(log.segments.distance_m[5:-5], V[5:-6] / 36.0, rtol=2e-3)
    assert "20 values of 0x18FEF117 (bus 1) beside the 200 of 0x18FEF100 (bus 1): left out" in said(log)


def test_a_database_of_ones_own(tmp_path):
    path, adapter = own(tmp_path)
    log = read_log(path, adapter)
    np.testing.assert_allclose(log.segments.distance_m, V / 36.0, rtol=1e-3)
    np.testing.assert_allclose(log.measured["battery_power_w"], 1e3 * (3.0 * np.arange(N) - 100.0))
    assert set(np.unique(log.segments.channels["ambient_temp_c"])) == {-5.0}
    np.testing.assert_array_equal(log.segments.channels["mode"], np.arange(N) // 100)
    assert "cabin" not in log.segments.channels
    text = write_adapter_skeleton(path, adapter)
    assert "# Speed: read as it is (speed_mps)" in text
    assert '"Cabin"' in text
    assert 'dbc = ["' in text


def test_what_the_database_calls_not_available_is_missing(tmp_path):
    speed = V.copy()
    speed[50:54] = np.nan
    log = read_log(*own(tmp_path, speed=speed))
    assert log.ledger.count("dropped", "Speed") == 4
    np.testing.assert_allclose(np.sum(log.segments.distance_m), np.sum(V) / 36.0, rtol=1e-2)


def test_all_ones_beyond_the_range_are_no_mass():
    """Whether or not the database says that its messages are of SAE J1939."""
    text = 'BU_: X\nBO_ 2566844672 Weights: 8 X\n SG_ Mass : 16|16@1+ (10,0) [0|64255] "kg" X\n'
    (message,) = cantools.database.load_string(f'VERSION ""\n{text}').messages
    data = np.array([[0, 0, 0xFF, 0xFF, 0, 0, 0, 0], [0, 0, 0x10, 0x01, 0, 0, 0, 0]], np.uint8)
    found = physical(message.signals[0], data, {}, False)
    np.testing.assert_array_equal(found, [np.nan, 2720.0])


@pytest.mark.parametrize("ending", ["blf", "asc"])
def test_two_recordings_in_one_file_are_not_mixed(tmp_path, ending):
    frames = drive()
    path = write(tmp_path / f"x.{ending}", frames)
    if ending == "asc":
        lines = path.read_text().splitlines(keepends=True)
        path.write_text("".join([*lines[:-1], *lines[5:]]))
    else:
        write(path, [*frames, *frames])
    with pytest.raises(InputError, match=r"the clock goes back from 19.*two recordings in one file"):
        read_log(path)


def test_faster_powers_are_averaged_and_states_kept(tmp_path):
    mdf, t = asammdf.MDF(version="4.10"), np.arange(0.0, 20.0, 0.01)
    mdf.append([asammdf.Signal(10.0 + T, T, name="v", unit="m/s")], comment="slow")
    fast = [asammdf.Signal(1.0 + np.sin(20.0 * np.pi * t), t, name="P", unit="kW")]
    mdf.append([*fast, asammdf.Signal((t > 10.0).astype("u1"), t, name="heater")], comment="fast")
    mdf.append([asammdf.Signal(np.full(20, 5.0), np.arange(20.0), name="v", unit="km/h")], comment="other")
    mdf.save(tmp_path / "x.mf4")
    columns = {"speed_mps": "slow.v", "battery_power_w": "P", "heater_on": "heater"}
    log = read_log(tmp_path / "x.mf4", Adapter.from_dict({"columns": columns}))
    assert len(log) == 200
    np.testing.assert_allclose(log.measured["battery_power_w"][1:-1], 1000.0, atol=60.0)
    np.testing.assert_array_equal(log.segments.channels["heater_on"], T > 10.0)
    assert "2000 values at the times of 'slow.v': the mean of those around a row" in said(log)
    even = read_log(tmp_path / "x.mf4", Adapter.from_dict({"columns": columns, "clock": 0.5}))
    np.testing.assert_allclose(np.diff(even.segments.time_s), 0.5)
    np.testing.assert_allclose(np.sum(even.target("energy_wh")), np.sum(log.target("energy_wh")), rtol=0.05)
    with pytest.raises(InputError, match=r"no signal 'v', but 'slow\.v' and 'other\.v'"):
        read_log(tmp_path / "x.mf4", Adapter.from_dict({"columns": {**columns, "speed_mps": "v"}}))
    with pytest.raises(InputError, match=r"no signal has a speed's name; it has slow\.v"):
        read_log(tmp_path / "x.mf4")


def test_a_database_within_the_file_decodes_its_frames(tmp_path):
    """As loggers attach it (ASAM MDF, bus logging): its signals are channels like any other."""
    from asammdf.blocks import v4_constants as blocks

    fields = [("BusChannel", "u1"), ("ID", "<u4"), ("IDE", "u1"), ("DLC", "u1"), ("DataLength", "u1")]
    records = np.zeros(N, [(f"CAN_DataFrame.{k}", t) for k, t in (*fields, ("DataBytes", "(8,)u1"))])
    for key, value in {"BusChannel": 1, "ID": 291, "DLC": 8, "DataLength": 8}.items():
        records[f"CAN_DataFrame.{key}"] = value
    records["CAN_DataFrame.DataBytes"][:, :2] = np.round(100 * V).astype(">u2")[:, None].view("u1")
    source = asammdf.Source("CAN1", "CAN1", "", blocks.SOURCE_BUS, blocks.BUS_TYPE_CAN)
    kept = (DBC.encode(), "truck.dbc", None)
    mdf = asammdf.MDF(version="4.10")
    mdf.append(asammdf.Signal(records, T, name="CAN_DataFrame", source=source, attachment=kept), acq_source=source)
    mdf.groups[0].channel_group.flags |= blocks.FLAG_CG_BUS_EVENT
    mdf.append(asammdf.Signal(T, T, name="P", unit="kW"))
    mdf.save(tmp_path / "x.mf4")
    columns = {"speed_mps": "Speed", "battery_power_w": "P"}
    log = read_log(tmp_path / "x.mf4", Adapter.from_dict({"columns": columns}))
    np.testing.assert_allclose(log.segments.distance_m, V / 36.0, rtol=1e-3)


@pytest.mark.parametrize("ending", ["blf", "mf4", "asc"])
def test_a_truncated_recording_is_refused(tmp_path, ending, capfd):
    path = write(tmp_path / f"x.{ending}", drive())
    data = path.read_bytes()
    for share in (0.1, 0.5, 0.9):
        path.write_bytes(data[: int(share * len(data))].rstrip(b"\n"))
        with pytest.raises(InputError, match="truncated"):
            read_log(path)
    assert capfd.readouterr().err == ""
    if ending == "asc":
        path.write_bytes(data[: data.rindex(b"\n", 0, len(data) // 2) + 1])
        assert "never closed by its recorder" in said(read_log(path))


def test_what_cannot_be_read_says_what_to_do(tmp_path, monkeypatch):
    path = write(tmp_path / "x.asc", drive())
    text = path.read_text().replace("timestamps absolute", "timestamps relative")
    (tmp_path / "rel.asc").write_text(text)
    with pytest.raises(InputError, match="save it with 'timestamps absolute'"):
        read_log(tmp_path / "rel.asc")
    plain = [can.Message(timestamp=t, arbitration_id=0x123, is_extended_id=False, data=b"12345678") for t in T]
    with pytest.raises(InputError, match=r'name the database, dbc = "….dbc".* the most frequent are 0x123'):
        read_log(write(tmp_path / "plain.blf", plain))
    with pytest.raises(InputError, match="the database cannot be read"):
        read_log(path, Adapter.from_dict({"dbc": "none.dbc"}))
    (tmp_path / "no.dbc").write_text("this is none")
    with pytest.raises(InputError, match="no database of CAN messages"):
        read_log(path, Adapter.from_dict({"dbc": str(tmp_path / "no.dbc")}))
    (tmp_path / "csv.blf").write_text("time_s,speed_mps\n0,1\n")
    with pytest.raises(InputError, match="its content is not"):
        read_log(tmp_path / "csv.blf")
    with pytest.raises(InputError, match=r"names none of its frames.* the most frequent are 0x18FEF100, 0x18F0905B"):
        read_log(path, own(tmp_path, "y.blf")[1])
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(InputError, match=r"reading \.asc needs can: pip install 'hdev_jax\[can\]'"):
        read_log(path)


@st.composite
def signals(draw):
    """A signal anywhere in 8 bytes, and frames."""
    real = draw(st.booleans())
    length = draw(st.sampled_from([32, 64]) if real else st.integers(1, 64))
    big = draw(st.booleans())
    free = 64 - length
    at = draw(st.integers(0, free))
    start = 8 * (at // 8) + 7 - at % 8 if big else at
    rows = draw(st.integers(0, 2**32 - 1))
    return (
        length,
        big,
        start,
        draw(st.booleans()),
        real,
        np.random.default_rng(rows).integers(0, 256, (7, 8), dtype=np.uint8),
    )


@settings(max_examples=200)
@given(signals())
def test_bits_are_those_of_cantools(made):
    length, big, start, signed, real, data = made
    order = "big_endian" if big else "little_endian"
    conversion = cantools.database.conversion.BaseConversion.factory(scale=0.5, offset=-3, is_float=real)
    signal = cantools.database.Signal("s", start, length, order, signed, conversion=conversion)
    message = cantools.database.Message(1, "m", 8, [signal], strict=False)
    expected = [message.decode(bytes(row), decode_choices=False)["s"] for row in data]
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(physical(signal, data, {"s": signal}, False), expected, rtol=1e-6 if real else 1e-12)
    short = physical(signal, data[:, : (start // 8)], {"s": signal}, False)
    assert np.isnan(short).all()


def disturbed(sender: int, lost: float, none: float, late: float, seed: int) -> tuple[list, int]:
    """The truck's frames as a bus gives them: late, lost, cut short, between faults; how many currents there are."""
    rng = np.random.default_rng(seed)
    frames, usable = [], 0
    for f in drive(sender):
        if rng.uniform() < lost:
            continue
        if rng.uniform() < none:  # not available, or too short to tell
            f.data = bytearray(b"\xff" * 8 if rng.uniform() < 0.5 else f.data[:3])
            f.dlc = len(f.data)
        else:
            usable += f.arbitration_id >> 8 & 0xFFFF == 0xF090
        if rng.uniform() < late:
            f.timestamp += 0.02 * rng.uniform()
        frames.append(f)
        if rng.uniform() < 0.02:
            frames.append(can.Message(timestamp=f.timestamp, is_error_frame=True))
            frames.append(can.Message(timestamp=f.timestamp, arbitration_id=0x18FEF100, is_remote_frame=True))
    return frames, usable


SHARE = st.sampled_from([0.0, 0.03])


@settings(max_examples=12)
@given(st.sampled_from(["blf", "asc", "mf4"]), st.integers(0, 0xFD), SHARE, SHARE, SHARE, st.integers(0, 2**32 - 1))
def test_no_disturbed_bus_is_another_drive(ending, sender, lost, none, late, seed):
    frames, usable = disturbed(sender, lost, none, late, seed)
    with tempfile.TemporaryDirectory() as folder:
        log = read_log(write(Path(folder) / f"x.{ending}", frames))
    t, d = np.asarray(log.segments.time_s), np.asarray(log.segments.duration_s)
    assert len(log.trip_names) == 1
    assert usable - 15 <= len(log) <= usable, "each measured current a row, but for the ends and for lost speeds"
    # the time is that of a row's begin, which a lost frame before it draws forward
    np.testing.assert_allclose(np.asarray(log.segments.distance_m) / d, np.interp(t, T, V) / 3.6, atol=0.2)
    np.testing.assert_allclose(log.measured["battery_power_w"], 600.0 * np.interp(t, T, AMPS), atol=3e3)
    assert 0.85 * T[-1] < np.sum(d) < T[-1] + 0.2
