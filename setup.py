from glob import glob

from setuptools import find_packages, setup

PACKAGE = "symbid_ros"
ROOMS = "report", "study"  # those with pages

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={
        PACKAGE: ["py.typed", *(f"{room}/*.{kind}" for room in ROOMS for kind in ("html", "css"))],
        f"{PACKAGE}.study": ["thesis/*.json"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", sorted(glob("config/*"))),
        (f"share/{PACKAGE}/launch", sorted(glob("launch/*.launch.py"))),
    ],
    install_requires=["setuptools"],
    # By this colcon knows that the tests are pytest's.
    extras_require={"test": ["pytest"]},
    python_requires=">=3.11",
    zip_safe=False,
    maintainer="symbid_ros maintainers",
    maintainer_email="maintainers@symbid-ros.org",
    description="Identifies inertial and friction parameters of robots from ROS 2 topics and bags",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "symbid = symbid_ros.cli.main:main",
            "mujoco_bridge = symbid_ros.ros.start:mujoco_bridge",
            "recorder = symbid_ros.ros.start:recorder",
            "balance_controller = symbid_ros.ros.start:balance_controller",
            "identifier = symbid_ros.ros.start:identifier",
            "monitor = symbid_ros.ros.start:monitor",
            "player = symbid_ros.ros.start:player",
        ],
    },
)
