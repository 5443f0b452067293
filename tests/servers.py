"""Real servers for tests, each in a folder of its own on the loopback address: PostgreSQL and an MQTT broker."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

__all__ = ["Broker", "Postgres", "free_port"]

POSTGRES = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda p: int(p.parent.name))
MOSQUITTO = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")
PASSWORD = "s3cret w0rd"


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def waited(port, process):
    """Until something listens there."""
    for _ in range(400):
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
        except OSError:
            assert process.poll() is None, "the server has ended"
            time.sleep(0.025)
        else:
            return
    raise AssertionError("the server does not listen")


class Server:
    """A process that a test stops and starts."""

    port: int
    process: subprocess.Popen | None = None

    def command(self) -> list[str]:
        raise NotImplementedError

    def start(self):
        self.process = subprocess.Popen(
            self.command(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, user=self.user, group=self.user
        )
        waited(self.port, self.process)

    def stop(self, how=signal.SIGINT):
        """PostgreSQL ends its sessions at once on SIGINT."""
        if self.process is not None:
            self.process.send_signal(how)
            self.process.wait(30)
            self.process = None

    @property
    def user(self):
        return None


class Postgres(Server):
    """A cluster; skips where the machine has none. `database()` is the URL of a new one, with a password."""

    def __init__(self, folder: Path):
        pytest.importorskip("psycopg", reason="psycopg is in the extra serve")
        if not POSTGRES:
            pytest.skip("no PostgreSQL on this machine (/usr/lib/postgresql)")
        self.bin, self.folder, self.port, self.count = POSTGRES[-1], folder, free_port(), 0
        if self.user:  # it does not run as root
            shutil.chown(folder, self.user, self.user)
        (folder / "password").write_text(PASSWORD)
        os.chmod(folder / "password", 0o644)
        subprocess.run(
            [self.bin / "initdb", "-D", folder / "data", "-U", "hdev", "--auth=scram-sha-256", "--encoding=UTF8",
             "--locale=C", "--no-sync", "--no-instructions", f"--pwfile={folder / 'password'}"],
            check=True, stdout=subprocess.DEVNULL, user=self.user, group=self.user, cwd="/",
        )  # fmt: skip
        self.start()

    @property
    def user(self):
        if os.geteuid():
            return None
        return "postgres"

    def start(self):
        super().start()
        import psycopg

        for _ in range(400):
            with contextlib.suppress(psycopg.OperationalError):  # "the database system is starting up"
                self.run("SELECT 1")
                return
            time.sleep(0.025)
        raise AssertionError("PostgreSQL does not start")

    def command(self):
        return [str(self.bin / "postgres"), "-D", str(self.folder / "data"), "-p", str(self.port), "-k", "", "-c",
                 "listen_addresses=127.0.0.1", "-c", "shared_buffers=16MB", "-c", "max_connections=20"]  # fmt: skip

    def url(self, database: str) -> str:
        return f"postgresql://hdev:{PASSWORD.replace(' ', '%20')}@127.0.0.1:{self.port}/{database}"

    def run(self, statement: str, database: str = "postgres"):
        import psycopg

        with psycopg.connect(self.url(database), autocommit=True) as db:
            cursor = db.execute(statement)
            return cursor.fetchall() if cursor.description else []

    def database(self, options: str = "") -> str:
        self.count += 1
        self.run(f"CREATE DATABASE d{self.count} {options}")
        return self.url(f"d{self.count}")


class Broker(Server):
    """mosquitto, that keeps what it has between two starts; skips where the machine has none."""

    def __init__(self, folder: Path):
        pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is in the extra mqtt")
        if MOSQUITTO is None:
            pytest.skip("no mosquitto on this machine")
        self.folder, self.port = folder, free_port()
        passwd = Path(MOSQUITTO).parent.parent / "bin" / "mosquitto_passwd"
        subprocess.run([passwd, "-b", "-c", folder / "passwords", "truck", PASSWORD], check=True, capture_output=True)
        (folder / "mosquitto.conf").write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npassword_file {folder / 'passwords'}\n"
            f"persistence true\npersistence_location {folder}/\n" + ("user root\n" if os.geteuid() == 0 else "")
        )
        self.start()

    def command(self):
        return [str(MOSQUITTO), "-c", str(self.folder / "mosquitto.conf")]


def started(*arguments, **options):
    """A command of hdev as a process of its own."""
    return subprocess.Popen([sys.executable, "-m", "hdev_jax.cli", *map(str, arguments)], **options)
