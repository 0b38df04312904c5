"""The network as a detector: the ONNX file, inference, and the check that it fits the camera."""
