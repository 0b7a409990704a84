"""The .ogpc file at runtime: reading and checking it, nearest-point search, adding words. Needs numpy alone.

`og_pointcloud_export` writes it.
"""
