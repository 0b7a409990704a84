"""From photographs to masks and mask features: proposers, encoders, and the work that fills a capture folder.

A proposer says where things are in an image, an encoder says in the words' feature space what a mask shows. Models of
the user's, OpenCV, files and callables stand behind the two protocols of ``contracts``; ``levels`` settles masks
that overlap.
"""
