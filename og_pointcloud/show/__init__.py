"""Visualization: pages, pictures of a fit's input and result, edited splats."""
