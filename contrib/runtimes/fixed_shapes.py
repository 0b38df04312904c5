"""Make a model.onnx ready for other runtimes: one frame at a time, the raster of float32.

python contrib/runtimes/fixed_shapes.py checkpoints/general/model.onnx ready.onnx

The properties of the file, which seal it, are left out: lanenet runs the original only.
"""

from __future__ import annotations

import sys

import numpy as np
import onnx
from onnx import numpy_helper


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
    _decode_floats(graph)
    onnx.checker.check_model(model)
    onnx.save(model, target)


def _decode_floats(graph: onnx.GraphProto) -> None:
    """Replace the node that decodes bytes by its arithmetic on floats: less the zero, times the scale."""
    (node,) = (each for each in graph.node if each.op_type == "DequantizeLinear")
    raster, scales, zeros = node.input
    values = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    for name in (scales, zeros):
        planes = values[name].astype(np.float32).reshape(-1, 1, 1)
        graph.initializer.append(numpy_helper.from_array(planes, f"{name}_float"))
    less = onnx.helper.make_node("Sub", [raster, f"{zeros}_float"], ["raster_less_zeros"])
    times = onnx.helper.make_node("Mul", ["raster_less_zeros", f"{scales}_float"], list(node.output))
    at = list(graph.node).index(node)
    graph.node.remove(node)
    graph.node.insert(at, times)
    graph.node.insert(at, less)


if __name__ == "__main__":
    main(*sys.argv[1:])
