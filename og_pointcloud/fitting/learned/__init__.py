"""OpenGaussian's method: instance features and a codebook, learned; as published, and without rendering."""
