"""What pyproject.toml cannot say, such as the files that ROS 2 looks for in ``share/``."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "symbid_ros"

setup(
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={
        PACKAGE: ["py.typed", "schemas/*.json"],
        f"{PACKAGE}.excitation": ["*.html", "*.css"],
        f"{PACKAGE}.report": ["*.html", "*.css", "*.js", "vendored/*"],
        f"{PACKAGE}.learning": ["*.html"],
        f"{PACKAGE}.study": ["*.html", "*.css", "thesis/*.json"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", sorted(glob("config/*"))),
        (f"share/{PACKAGE}/launch", sorted(glob("launch/*.launch.py"))),
    ],
    python_requires=">=3.11",
    include_package_data=False,
    zip_safe=False,
    license="Apache-2.0",
)
