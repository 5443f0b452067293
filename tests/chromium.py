"""A real browser that a test drives: Chromium's debugging protocol over a pipe."""

import contextlib
import json
import os
import shutil
import subprocess
import sys

__all__ = ["CHROMIUM", "FLAGS", "Page", "opened"]

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip


class Page:
    """One page. `errors` are what it logged as such so far."""

    def __init__(self, to, back):
        self.to, self.back, self.number, self.session, self.errors = to, back, 0, None, []

    def call(self, method, **params):
        """The answer to one command; what happens meanwhile is noted."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        self.to.write(json.dumps(message).encode() + b"\0")
        self.to.flush()
        while True:
            got = json.loads(self._message())
            if got.get("method") == "Runtime.exceptionThrown":
                self.errors.append(got["params"]["exceptionDetails"]["text"])
            if got.get("method") == "Log.entryAdded" and got["params"]["entry"]["level"] == "error":
                self.errors.append(got["params"]["entry"]["text"])
            if got.get("id") == self.number:
                assert "error" not in got, got
                return got["result"]

    def _message(self):
        parts = bytearray()
        while (byte := self.back.read(1)) != b"\0":
            assert byte, "Chromium has ended"
            parts += byte
        return bytes(parts)

    def value(self, javascript):
        """What an expression, or its promise, comes to."""
        found = self.call("Runtime.evaluate", expression=javascript, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")


@contextlib.contextmanager
def opened(url, folder, width=1280, height=900):
    """A page at an address, in a browser of its own whose profile is in `folder`."""
    theirs, to = os.pipe()
    back, ours = os.pipe()

    # the protocol's two pipes are its file descriptors 3 and 4
    command = [CHROMIUM, *FLAGS, "--remote-debugging-pipe", f"--user-data-dir={folder}", "about:blank"]
    starter = (
        f"import os, fcntl; a, b = (fcntl.fcntl(f, fcntl.F_DUPFD, 10) for f in ({theirs}, {ours})); "
        f"os.dup2(a, 3); os.dup2(b, 4); os.execv({command[0]!r}, {command!r})"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", starter], pass_fds=(theirs, ours), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    os.close(theirs)
    os.close(ours)
    try:
        with open(to, "wb") as write, open(back, "rb") as read:
            page = Page(write, read)
            target = page.call("Target.createTarget", url="about:blank")["targetId"]
            page.session = page.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Log"):
                page.call(f"{domain}.enable")
            page.call(
                "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
            )
            page.call("Page.navigate", url=url)
            yield page
    finally:
        process.kill()
        process.wait()
