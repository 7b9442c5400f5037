"""The only import of ONNX Runtime: its telemetry, which is on by default, is off before it begins.

From 1.29 on it would send events to its maker, and leave files in the temporary folder and in the
user's cache (https://github.com/microsoft/onnxruntime/blob/main/docs/Privacy.md).
"""

import os

os.environ["ORT_DISABLE_TELEMETRY"] = "1"

import onnxruntime

__all__ = ["onnxruntime"]
