"""Scores by the protocols of published tables, and what these leave unsaid: abstention, spread, instances, boxes.

``og_pointcloud.evaluate.metrics`` scores one labelling; here stand the data sets' rules about what is counted.
"""
