"""The .ogpc file as the runtime sees it: read and checked, its nearest points found, words added. numpy alone.

What writes one is `og_pointcloud_export`.
"""
