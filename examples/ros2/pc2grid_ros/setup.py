"""How colcon builds the package."""

from setuptools import setup

NAME = "pc2grid_ros"
setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/pc2grid.launch.py"]),
        (f"share/{NAME}/config", ["config/pc2grid.yaml"]),
    ],
    install_requires=["setuptools", "pc2grid"],
    license="MIT",
    description="Finds where a robot is in a pc2grid database, and tells nav2.",
    entry_points={"console_scripts": [f"pc2grid = {NAME}.node:main"]},
)
