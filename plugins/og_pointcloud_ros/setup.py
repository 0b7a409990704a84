"""What colcon builds; pip installs this package with og-pointcloud instead."""

from setuptools import setup

NAME = "og_pointcloud_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    package_dir={NAME: "."},  # this folder is the package
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/segment.launch.xml", "launch/map.launch.xml"]),
        (f"share/{NAME}/config", ["config/parameters.yaml", "config/map.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    author="The og_pointcloud contributors",
    description="Labels point clouds by words, with the map that og_pointcloud fitted.",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"segment = {NAME}.node:main", f"map = {NAME}.map_node:main"]},
)
