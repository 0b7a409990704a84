"""Queries to a labelled cloud: words in, labelled points out. Needs numpy and onnxruntime alone."""
