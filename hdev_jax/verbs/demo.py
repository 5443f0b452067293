"""The verb `demo`: a synthetic truck's log with an effect that its sheet does not declare, and its diagnosis."""

from pathlib import Path

from hdev_jax import progress
from hdev_jax.errors import InputError
from hdev_jax.fleet import demo_log
from hdev_jax.verbs.diagnose import diagnose

__all__ = ["demo"]


def demo(*, out: str | Path = Path("hdev_demo"), seed: int = 3) -> str:
    """Write a log and a sheet as a customer would send them into the folder `out`, diagnose them into `out/result`, and
    say what was planted. `seed`: of the synthetic log. **Returns:** the answer as text. Raises `InputError`."""
    out = Path(out)
    progress.step("a heavy truck's log (synthetic)")
    synthetic = demo_log(seed)
    try:
        files = synthetic.write(out, truth=False)
    except OSError as e:
        raise InputError(f"--out {out}: cannot be written ({e.strerror or e}); name a folder that you may write") from e
    answer = diagnose([files["log"]], files["sheet"], out=out / "result")
    planted = "; ".join(
        f"{name} ({', '.join(f'{k} {v:g}' for k, v in sizes.items())})"
        for name, sizes in synthetic.vehicle.effects.items()
    )
    return f"{answer}\nplanted (synthetic): {planted}; noise {synthetic.noise_rms:.2f} Wh RMS a row"
