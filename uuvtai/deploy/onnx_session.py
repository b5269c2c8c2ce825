"""The one place that imports ONNX Runtime: its telemetry is off before it is loaded, and its sessions run on
one thread."""

from __future__ import annotations

import importlib.util
import os
from typing import Any

NAME = "onnxruntime"
VARIABLE = "ORT_DISABLE_TELEMETRY"
"""read by ONNX Runtime when it is loaded, from 1.29 on; before that it had no telemetry outside Windows"""


def is_installed() -> bool:
    """Whether graphs can be read and run here."""
    return all(importlib.util.find_spec(name) is not None for name in (NAME, "onnx"))


def without_telemetry() -> None:
    """Set the variable; whoever may cause ONNX Runtime to be loaded, torch's exporter included, calls this
    first."""
    os.environ[VARIABLE] = "1"


def session(graph: bytes) -> Any:
    """An InferenceSession on one thread of the CPU. Raises what ONNX Runtime raises."""
    without_telemetry()
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
