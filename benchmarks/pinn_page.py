"""docs/pinn_speed.md of what `pinn.py` measured."""

from collections.abc import Mapping
from typing import Any

__all__ = ["page"]

PARTS = {"whole": "the loss of equation 7, kernel included", "network": "squared error of the energy output alone"}
SIDES = {"ours": "ours", "cpu": "ours, on the processor", "loop": "plain JAX loop", "torch_1": "PyTorch, one thread",
         "torch_2": "PyTorch, two threads"}  # fmt: skip


def page(out: Mapping[str, Any], limits: Mapping[str, float], command: str) -> str:
    """The page, with targets beside what was measured."""
    lines = [
        "# Networks with physics: speed", "",
        f"Made by `{command}` on {out['device']}, {out['cores']} cores, float32; load average before the run",
        f"{out['load']:.1f}. Synthetic rows. The programs run in turns, one epoch each; numbers are for the median "
        "epoch,",
        "without compiling. PyTorch has the same network, batch and loss"
        + (f" (the losses agree to {out['same_loss']:.0e})." if "same_loss" in out else "."), "",
    ]  # fmt: skip
    if any(k.startswith("whole") for k in out):
        lines += [f"## Training: 256-128 units, batches of 1,024, Adam, {out['rows']:,} rows", "",
                  "| loss | dropout | program | thousand rows per second | thousand rows per CPU second | speed of "
                  "ours over it |",
                  "|---|---|---|---:|---:|---:|"]  # fmt: skip
        for part, what in PARTS.items():
            for dropout in ("0.1", "0"):
                lines += [_line(out, part, what, dropout, side) for side in SIDES
                          if f"{part}_dropout_{dropout}_{side}_per_s" in out]  # fmt: skip
        lines += [
            "", "Training on 70 % of 550,000 rows for 100 epochs with dropout would take, by the median epoch, "
            f"{out['paper_minutes']:.1f} minutes (target {limits['paper_minutes']:g}).",
            "", _why(out, limits["over_loop"]), "",
        ]  # fmt: skip
    if "many_rows_s" in out:
        lines += ["## Inference", "", "| what | measured | target |", "|---|---:|---:|"]
        lines += [
            f"| one row, called from Python, weights compiled as constants | {out['ready_one_row_us']:.0f} µs | "
            f"{limits['ready_one_row_us']:g} µs |",
            f"| one row, called from Python | {out['predict_one_row_us']:.0f} µs | – |",
            f"| 550,000 rows | {out['many_rows_s']:.2f} s | {limits['many_rows_s']:g} s |",
            "",
        ]
    if "grid_minutes" in out:
        lines += [
            "## Networks trained together, 20,000 rows (19 whole batches of 1,024)",
            "",
            "| networks | µs per network and row |",
            "|---|---:|",
        ]
        lines += [f"| {k.split('_')[1]} | {v:.2f} |" for k, v in out.items()
                  if k.startswith("members_") and k.endswith("_us") and "cpu" not in k]  # fmt: skip
        lines += ["", f"A grid of 75 weights and 3 seeds, 100 epochs each at the pace of 16 networks: "
                      f"{out['grid_minutes']:.1f} minutes (target {limits['grid_minutes']:g})."]  # fmt: skip
    return "\n".join(lines).rstrip() + "\n"


def _line(out: Mapping[str, Any], part: str, what: str, dropout: str, side: str) -> str:
    name = f"{part}_dropout_{dropout}"
    mine, theirs = out[f"{name}_ours_per_s"], out[f"{name}_{side}_per_s"]
    ratio = "" if side == "ours" else f"{mine / theirs:.2f}"
    cpu = out[f"{name}_{side}_cpu_per_s"]
    return f"| {what} | {dropout} | {SIDES[side]} | {theirs / 1e3:.0f} | {cpu / 1e3:.0f} | {ratio} |"


def _why(out: Mapping[str, Any], wanted: float) -> str:
    """Why a loop from Python is not slower than it is."""
    step = {side: 1024e3 / out[f"whole_dropout_0.1_{side}_per_s"] for side in ("ours", "loop")}
    over = step["loop"] / step["ours"]
    if over >= wanted:
        return f"A step called from Python takes {over:.1f} times ours (target {wanted:g})."
    return (
        f"A step takes {step['ours']:.2f} ms in our compiled loop and {step['loop']:.2f} ms in a Python loop that "
        f"draws each batch: {over:.2f} times as long (target: {wanted:g} times). With this network nearly all of a "
        f"step is arithmetic, which is the same in both. The Python loop adds {step['loop'] - step['ours']:.2f} ms; "
        f"for the target it would have to add {wanted - 1:g} times the arithmetic."
    )
