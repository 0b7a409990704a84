"""Answers made visible: a page, pictures of what a fit saw and made, edited splats."""
