"""The network as a detector: the ONNX file, the check that it fits, and inference."""
