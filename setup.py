"""What colcon needs to see in setup.py; pyproject.toml says everything else."""

from pathlib import Path

from setuptools import setup

PACKAGE = "dyfn_ros"
SHARE = f"share/{PACKAGE}"


def files(folder: str) -> list[str]:
    """The files of a folder beside this script, none where it is not; as setuptools wants them."""
    return sorted(str(path) for path in Path(folder).glob("*") if path.is_file())


setup(
    # colcon reads this script's settings as their repr, and what setuptools makes of
    # `requires-python` in pyproject.toml has a repr that is no Python.
    python_requires=">=3.10",
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/config", files("config")),
        (f"{SHARE}/config/cameras", files("config/cameras")),
        (f"{SHARE}/config/recipes", files("config/recipes")),
        (f"{SHARE}/launch", files("launch")),
        (f"{SHARE}/bags/demo", files("bags/demo")),
    ],
)
