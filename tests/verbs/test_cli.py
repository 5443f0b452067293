"""The command line: what each verb passes on, and what each failure says and returns."""

import argparse
import importlib
import inspect
import os
import subprocess
import sys
import types
from pathlib import Path

import jax
import pytest

import hdev_jax
from hdev_jax import cli, progress
from hdev_jax.errors import InputError
from hdev_jax.options.energy import ENERGY_VERBS

VERBS = (
    "check", "init", "diagnose", "calibrate", "predict", "follow", "serve", "export", "fleet", "simulate", "demo",
    "effects", *ENERGY_VERBS,
)  # fmt: skip
SHEET = ["--vehicle", "v.toml"]


def home_of(verb: str) -> str:
    return f"hdev_jax.verbs.{cli.FOLDERS.get(verb, '')}{verb}"


@pytest.fixture
def api(monkeypatch):
    """Modules in place of `hdev_jax.verbs.*` that record calls; `api.result` is returned, or raised."""
    fake = types.SimpleNamespace()
    fake.result, fake.calls = "the result", []

    def answer(verb):
        def call(**arguments):
            fake.calls.append((verb, arguments))
            if isinstance(fake.result, BaseException):
                raise fake.result
            return fake.result

        return call

    for verb in VERBS:
        module = types.ModuleType(home_of(verb))
        setattr(module, verb, answer(verb))
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.delenv("HDEV_DEBUG", raising=False)
    return fake


def usage_error(capsys, *argv: str) -> str:
    with pytest.raises(SystemExit) as exit_:
        cli.main(argv)
    assert exit_.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


def test_every_option_reaches_the_function(api, capsys):
    argv = ["diagnose", "a.csv", "b.mat", "--vehicle", "v.toml", "--adapter", "a.toml", "--target", "energy_wh"]
    argv += ["--train-trips", "1,2", "--test-trips", "3, 4", "--effects", "mine.py", "--only", "headwind,pto"]
    argv += ["--exclude", "drafting", "--fdr", "0.1", "--trust", "--out", "res", "--seed", "7"]
    assert cli.main(argv) == 0
    assert api.calls == [
        (
            "diagnose",
            {
                "logs": [Path("a.csv"), Path("b.mat")],
                "vehicle": Path("v.toml"),
                "adapter": Path("a.toml"),
                "target": "energy_wh",
                "train_trips": ("1", "2"),
                "test_trips": ("3", "4"),
                "effects": Path("mine.py"),
                "only": ("headwind", "pto"),
                "exclude": ("drafting",),
                "fdr": 0.1,
                "trust": True,
                "out": Path("res"),
                "seed": 7,
            },
        )
    ]
    assert capsys.readouterr().out == "the result\n"
    assert jax.config.jax_enable_x64


@pytest.mark.parametrize(
    ("argv", "arguments"),
    [
        (["check", "a.csv"], {"vehicle": None, "adapter": None, "skeleton": False}),
        (["check", "a.csv", "--skeleton"], {"vehicle": None, "adapter": None, "skeleton": True}),
        (
            ["calibrate", "a.csv", *SHEET, "--out", "c"],
            {"method": "map", "noise": "normal", "seed": 0, "out": Path("c")},
        ),
        (["predict", "a.csv", *SHEET, "--out", "p.csv"], {"target": None, "level": 0.9, "out": Path("p.csv")}),
        (["diagnose", "a.csv", *SHEET, "--out", "d"], {"fdr": 0.05, "only": None, "train_trips": None}),
    ],
    ids=lambda x: " ".join(x[:3]) if isinstance(x, list) else "",
)
def test_defaults(api, argv, arguments):
    assert cli.main(argv) == 0
    ((verb, passed),) = api.calls
    assert verb == argv[0]
    assert passed["logs"] == [Path("a.csv")]
    assert arguments.items() <= passed.items()


def test_each_verb_is_the_function_of_that_name_and_arguments():
    (subparsers,) = (a for a in cli.parser()._actions if isinstance(a, argparse._SubParsersAction))
    assert set(subparsers.choices) == set(VERBS)
    for verb, sub in subparsers.choices.items():
        options = {a.dest: a for a in sub._actions if a.dest != "help"}
        parameters = inspect.signature(getattr(importlib.import_module(home_of(verb)), verb)).parameters
        assert set(options) == set(parameters), verb
        for name, option in options.items():
            if not option.required:
                assert parameters[name].default == option.default, f"{verb} {name}"


@pytest.mark.parametrize("verb", ["", *VERBS])
def test_help_explains(verb, capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main([verb, "--help"] if verb else ["--help"])
    assert exit_.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: hdev {verb}".rstrip() in text
    assert "\n  hdev " in text or verb == "effects", "examples"


def test_alone_it_says_what_to_do_first(capsys, api):
    assert cli.main([]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert all(f"  hdev {verb} " in captured.out for verb in ("demo", "check", "diagnose", "predict"))
    assert api.calls == []


def test_version(capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["--version"])
    assert exit_.value.code == 0
    assert capsys.readouterr().out == f"hdev {hdev_jax.__version__}\n"


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["diagnos"], "invalid choice: 'diagnos'"),
        (["diagnose", "a.csv"], "required: --vehicle, --out"),
        (["check"], "required: LOG"),
        (["check", "a.csv", "--skel"], "unrecognized arguments: --skel"),
        (["diagnose", "a.csv", *SHEET, "--out", "d", "--fdr", "5"], "between 0 and 1, found '5'"),
        (["diagnose", "a.csv", *SHEET, "--out", "d", "--fdr", "nan"], "between 0 and 1, found 'nan'"),
        (["diagnose", "a.csv", *SHEET, "--out", "d", "--seed", "-1"], "expected a whole number"),
        (["diagnose", "a.csv", *SHEET, "--out", "d", "--train-trips", "1,,2"], "separated by commas, found '1,,2'"),
        (["diagnose", "a.csv", *SHEET, "--out", "d", "--target", "power"], "invalid choice: 'power'"),
        (["calibrate", "a.csv", *SHEET, "--out", "d", "--method", "ols"], "invalid choice: 'ols'"),
    ],
)
def test_usage_errors_are_one_line_and_exit_2(api, capsys, argv, says):
    line = usage_error(capsys, *argv)
    assert says in line
    assert "--help)" in line
    assert not api.calls


@pytest.mark.parametrize(
    ("raised", "status", "line"),
    [
        (InputError("a.csv, row 7:\n time runs backwards"), 2, "hdev: a.csv, row 7: time runs backwards"),
        (KeyboardInterrupt(), 130, "hdev: interrupted; the same command resumes"),
        (ValueError("two\nlines"), 1, "hdev: internal error: ValueError: two lines (HDEV_DEBUG=1 shows the traceback)"),
        (MemoryError(), 1, "hdev: internal error: MemoryError: (HDEV_DEBUG=1 shows the traceback)"),
    ],
    ids=["input", "interrupt", "ours", "memory"],
)
def test_failures_are_one_line(api, capsys, monkeypatch, raised, status, line):
    api.result = raised
    argv = ["diagnose", "a.csv", *SHEET, "--out", "d"]
    assert cli.main(argv) == status
    captured = capsys.readouterr()
    assert captured.err == line + "\n"
    assert captured.out == ""
    monkeypatch.setenv("HDEV_DEBUG", "1")
    assert cli.main(argv) == status
    assert "Traceback" in capsys.readouterr().err


def test_rows_are_printed_as_a_table(api, capsys):
    api.result = [
        {"id": "headwind", "equation": "F = ½ρ[c_d A](v + w)²", "needs": ("wind_speed_mps", "heading_rad")},
        {"id": "pto", "equation": "P = P₀" + " + 0" * 60, "needs": ()},
    ]
    assert cli.main(["effects"]) == 0
    head, first, second = capsys.readouterr().out.splitlines()
    assert head.split() == ["id", "equation", "needs"]
    assert first.startswith("headwind  F = ½ρ[c_d A](v + w)²")
    assert first.endswith("wind_speed_mps, heading_rad")
    assert second.endswith("+ 0"), "a row stays one line in a pipe"


def test_nothing_to_print(api, capsys):
    api.result = None
    assert cli.main(["effects"]) == 0
    assert capsys.readouterr().out == ""


def test_a_reader_that_stops_early_is_no_error():
    code = (
        "import sys, types; m = types.ModuleType('hdev_jax.verbs.effects'); m.effects = lambda: 'x\\n' * 100000\n"
        "sys.modules[m.__name__] = m\n"
        "from hdev_jax.cli import main; sys.exit(main(['effects']))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.readline()
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait() == 0


def test_help_is_quick_to_import():
    code = "import sys, hdev_jax.cli as c; c.parser(); print({'jax', 'numpy', 'rich'} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=dict(os.environ))
    assert out.stdout == "set()\n"


def test_progress_is_silent_in_the_library_and_a_line_a_step_in_a_command(capsys):
    progress.step("unseen")
    assert list(progress.track([1, 2], "unseen")) == [1, 2]
    assert capsys.readouterr().err == ""
    with progress.shown():
        progress.step("reading [a.csv]")
        assert list(progress.track(iter([1, 2]), "resampling", total=2)) == [1, 2]
    captured = capsys.readouterr()
    assert captured.out == ""
    assert [line.split("s  ")[1] for line in captured.err.splitlines()] == ["reading [a.csv]", "resampling"]


def test_a_long_loop_says_in_a_pipe_how_far_it_is(capsys, monkeypatch):
    monkeypatch.setattr(progress, "EVERY_S", -1.0)
    with progress.shown():
        assert list(progress.track("abc", "resampling")) == ["a", "b", "c"]
        assert list(progress.track(iter("ab"), "reading")) == ["a", "b"]
    lines = [line.split("s  ")[1] for line in capsys.readouterr().err.splitlines()]
    assert lines == ["resampling", "resampling: 1 of 3", "resampling: 2 of 3", "reading", "reading: 1", "reading: 2"]


def test_the_size_of_a_log_decides_how_it_is_compiled_and_the_users_flags_have_the_last_word(
    api, monkeypatch, tmp_path
):
    small, large = tmp_path / "small.csv", tmp_path / "large.csv"
    small.write_text("a,b\n")
    large.write_bytes(b"0" * 4_000_000)
    packed = tmp_path / "packed.csv.gz"
    packed.write_bytes(b"0" * 1_000_000)
    huge = tmp_path / "huge.csv"
    with huge.open("wb") as f:
        f.truncate(60_000_000)
    for logs, level in (
        ([huge], None), ([small, huge], None), ([small], 0), ([small, large], 1), ([packed], 1),
        ([tmp_path / "none.csv"], 0),
    ):  # fmt: skip
        monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=2")
        assert cli.main(["diagnose", *map(str, logs), *SHEET, "--out", str(tmp_path / "out")]) == 0
        flags = os.environ["XLA_FLAGS"].split()
        assert ("--xla_cpu_use_fusion_emitters=false" in flags) == (level is not None)
        assert f"--xla_backend_optimization_level={level}" in flags or level is None
        assert flags[-1] == "--xla_backend_optimization_level=2"
    once = os.environ["XLA_FLAGS"]
    cli.main(["check", str(large)])
    assert os.environ["XLA_FLAGS"] == once
