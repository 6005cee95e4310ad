"""ONNX graphs: built node by node, and run by onnxruntime."""
