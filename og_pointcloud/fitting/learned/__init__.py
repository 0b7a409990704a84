"""OpenGaussian's learned instance features and codebook, both as published and without rendering."""
