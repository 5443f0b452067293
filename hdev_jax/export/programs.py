"""The kernel as a compiled function for other programs: StableHLO and ONNX, any number of rows a call."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.export.exported import Exported
from hdev_jax.export.kernel import Kernel

__all__ = ["OUTPUT", "onnx", "stablehlo"]

OUTPUT = "energy_wh"


def stablehlo(kernel: Kernel) -> Exported:
    """Serialised by `jax.export`, in float64, for CPUs; `jax.export.deserialize(bytes).call(*columns)` runs it.

    The StableHLO module inside it is `deserialize(bytes).mlir_module()`. Raises `InputError` where the package
    `flatbuffers` (extra `export`), which JAX writes it with, is not installed.
    """
    if find_spec("flatbuffers") is None:
        raise InputError('--to stablehlo needs the package flatbuffers: pip install "hdev_jax[export]"')
    (batch,) = jax.export.symbolic_shape("b")
    columns = [jax.ShapeDtypeStruct((batch,), jnp.float64)] * len(kernel.inputs)
    program = jax.export.export(jax.jit(kernel.function()), platforms=("cpu",))(*columns)
    about = {"dtype": "float64", "platforms": ["cpu"], "calling_convention_version": program.calling_convention_version}
    return Exported(bytes(program.serialize()), _described(kernel) | about, kernel.left_out)


def onnx(kernel: Kernel) -> Exported:
    """An ONNX model of one input for each column, by name, in float64 (package `jax2onnx`, extra `export`).

    Raises `InputError` where that package is not installed.
    """
    try:
        to_onnx = import_module("jax2onnx").to_onnx
    except ImportError as e:
        raise InputError('--to onnx needs the package jax2onnx: pip install "hdev_jax[export]"') from e
    columns: list[Any] = [("b",)] * len(kernel.inputs)
    model = to_onnx(
        kernel.function(), columns, model_name="hdev_jax", enable_double_precision=True,
        input_names=list(kernel.inputs), output_names=[OUTPUT],
    )  # fmt: skip
    about = {"dtype": "float64", "opset": int(np.max([o.version for o in model.opset_import if not o.domain]))}
    return Exported(model.SerializeToString(), _described(kernel) | about, kernel.left_out)


def _described(kernel: Kernel) -> dict[str, Any]:
    return {"inputs": kernel.described(), "output": {"name": OUTPUT, "unit": "watt_hour"}}
