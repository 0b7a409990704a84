"""From photographs to masks and mask features: proposers, encoders, and the code that fills a capture folder.

A proposer says where things are in an image; an encoder describes what a mask shows, in the words' feature space.
Users' models, OpenCV, files and callables implement the two protocols of ``contracts``; ``levels`` resolves overlaps.
"""
