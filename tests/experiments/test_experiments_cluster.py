"""A sweep on a Dask cluster: a scheduler and two workers, one of them killed with a task in its hands."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from experiments.runner.engine import run_config

ROOT = Path(__file__).parents[2]
CONFIG = """
experiment = "toy_studies.squares"
count = 4
noise.scale = 0.5
[sweep]
seed = [1, 2]
"""


def until(condition, what, seconds=300):
    for _ in range(int(seconds * 20)):
        if found := condition():
            return found
        time.sleep(0.05)
    return pytest.fail(f"{what}: not in {seconds} s")


class Processes(ExitStack):
    """Processes that end with the test, started as by hand from the checkout."""

    def __init__(self, folder):
        super().__init__()
        path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "experiments"), os.environ.get("PYTHONPATH", "")])
        self.folder, self.environment = folder, {**os.environ, "PYTHONPATH": path}

    def start(self, name, *words):
        with open(self.folder / f"{name}.txt", "w") as log:
            command = [sys.executable, "-m", *map(str, words)]
            process = subprocess.Popen(command, cwd=ROOT, env=self.environment, stdout=log, stderr=log)
        self.callback(process.wait)
        self.callback(process.kill)
        return process

    def told(self, name):
        return (self.folder / f"{name}.txt").read_text()


@pytest.mark.slow
def test_a_sweep_outlives_a_worker_and_its_numbers_are_those_of_one_process(tmp_path):
    (tmp_path / "c.toml").write_text(CONFIG)
    diary, address = tmp_path / "diary", tmp_path / "scheduler.json"
    diary.mkdir()
    with Processes(tmp_path) as processes:
        quiet = ("--no-dashboard", "--scheduler-file", address)
        processes.start("scheduler", "dask", "scheduler", "--host", "127.0.0.1", "--port", "0", *quiet)
        alone = ("--nthreads", "1", "--no-nanny", "--local-directory", tmp_path / "local")
        workers = [processes.start(f"worker{k}", "dask", "worker", *quiet, *alone) for k in range(2)]
        here = run_config(tmp_path / "c.toml", out=tmp_path / "here")  # while they start, and wait for its file
        until(lambda: processes.told("scheduler").count("Register worker") == 2, "two workers")
        sweep = processes.start(
            "sweep", "experiments", tmp_path / "c.toml", "--set", f"diary={diary}", "--set", "wait_s=0.5",
            "--out", tmp_path / "cluster", "--scheduler", address,
        )  # fmt: skip

        # a task takes a while there: a worker that starts later than the other finds some left
        def of(worker):
            return [p.name.partition("-")[0] for p in diary.glob(f"*-{worker.pid}")]

        until(lambda: all(map(of, workers)), "tasks on both workers")
        kept = tmp_path / "cluster" / "tasks"
        until(lambda: list(kept.rglob("*.json")), "a result")
        workers[0].send_signal(signal.SIGKILL)
        assert sweep.poll() is None, "killed in the middle"
        assert sweep.wait(120) == 0, processes.told("sweep")
    found = json.loads((tmp_path / "cluster" / "sweep.json").read_text())
    assert [r["sweep"] for r in found] == [r["sweep"] for r in here]
    assert [r["rows"] for r in found] == [r["rows"] for r in here]
    assert all(r["rows"][0]["ours"]["x64"] for r in found)
    environment = json.loads((Path(found[0]["folder"]) / "environment.json").read_text())
    assert environment["scheduler"] == str(address)


def test_no_cluster_is_one_line_and_loses_nothing(tmp_path, capsys, monkeypatch):
    from experiments.__main__ import main
    from experiments.runner import workers

    (tmp_path / "c.toml").write_text(CONFIG.partition("[sweep]")[0])
    monkeypatch.setattr(workers, "PATIENCE", 0.5)
    command = [str(tmp_path / "c.toml"), "--out", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:9"]
    assert main(command) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("experiments: --scheduler tcp://127.0.0.1:9: no scheduler answers there")
    assert (tmp_path / "out.partial" / "config.toml").exists()
    (tmp_path / "none.json").write_text("{}")
    assert main([*command[:-1], str(tmp_path / "none.json")]) == 2
    assert "none.json: is no scheduler's file" in capsys.readouterr().err.splitlines()[-1]
