"""Make a model.onnx ready for other runtimes: one frame at a time, the raster of float32.

python contrib/runtimes/fixed_shapes.py checkpoints/general/model.onnx ready.onnx

The properties of the file, which seal it, are left out: lanenet runs the original only.
"""

from __future__ import annotations

import sys

import onnx


def main(source: str, target: str) -> None:
    """Read one file and write the other."""
    model = onnx.load(source)
    graph = model.graph
    graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.FLOAT
    for value in (*graph.input, *graph.output):
        value.type.tensor_type.shape.dim[0].dim_value = 1
    # The width's default, with which other tools may take the width for a constant.
    names = {value.name for value in graph.input}
    constants = [each for each in graph.initializer if each.name not in names]
    del graph.initializer[:], model.metadata_props[:]
    graph.initializer.extend(constants)
    onnx.checker.check_model(model)
    onnx.save(model, target)


if __name__ == "__main__":
    main(*sys.argv[1:])
