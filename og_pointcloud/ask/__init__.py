"""Words in, labelled points out: what answers from a labelled cloud. numpy and onnxruntime, nothing else."""
