"""ONNX graphs: built node by node, and run by onnxruntime. Nothing here knows of networks or images."""
