"""What the genuine TensorRT bindings are called, version by version: see ``__main__``."""
