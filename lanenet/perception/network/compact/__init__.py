"""The compact networks without onnxruntime, in compiled loops."""
