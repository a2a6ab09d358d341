"""Fixtures that every test may use."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.moge import MoGeConfig, MoGeModel
from tests.support.golden2 import Golden2
from tests.support.pinhole import PinholeModel
from tests.support.seeded import redraw

THREADS = torch.get_num_threads()
ROOT = Path(__file__).resolve().parents[1]
# Processes that tests start find the packages, and tests.support, as this process does.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
GOLDEN = ROOT / "tests" / "golden"
# What a marker means is in pyproject.toml; these are the places and fixtures whose tests carry it.
ROS_PLACES = (
    "tests/ros/node",
    "tests/ros/demo",
    "tests/ros/replay/test_online_offline.py",
    "tests/ros/replay/test_same_session.py",
)
MARKED_FIXTURES = {"gl": {"renderer"}, "golden": {"shared_dir", "golden_file", "golden_losses"}}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks that follow from where a test is and what it asks for, so that nobody forgets one."""
    places = {ROOT / place for place in ROS_PLACES}
    for item in items:
        if places.intersection([item.path, *item.path.parents]):
            item.add_marker("ros")
        for marker, fixtures in MARKED_FIXTURES.items():
            if fixtures.intersection(getattr(item, "fixturenames", ())):
                item.add_marker(marker)


def _shared() -> Path:
    return Path(os.environ.get("DYFN_SHARED", ROOT.parent / "shared"))


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of large golden files and real recordings, which not every machine has."""
    path = _shared()
    if not path.is_dir():
        pytest.skip(f"{path} is absent: set DYFN_SHARED to the folder of golden files")
    return path


@pytest.fixture(scope="session")
def golden_file(request: pytest.FixtureRequest) -> Callable[[str], Path]:
    """Where a golden file is: in the repository, or else among the large ones of shared_dir."""

    def find(name: str) -> Path:
        if (GOLDEN / name).exists():
            return GOLDEN / name
        shared: Path = request.getfixturevalue("shared_dir")
        return shared / "golden" / name

    return find


@pytest.fixture(scope="session")
def golden2(shared_dir: Path) -> Golden2:
    """The golden files of MoGe v2 and Depth Anything 3."""
    folder = shared_dir / "golden2"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    return Golden2(folder)


@pytest.fixture(scope="session")
def golden_losses() -> Path:
    """All recorded losses and alignments where they are, else the repository's part of them."""
    whole = _shared() / "golden" / "losses_alignment.npz"
    return whole if whole.exists() else GOLDEN / "losses_alignment_small.npz"


@pytest.fixture(autouse=True)
def same_threads() -> None:
    """Training sets the process's thread count, and the last bits of a gradient depend on it."""
    torch.set_num_threads(THREADS)


@pytest.fixture
def pinhole() -> PinholeModel:
    return PinholeModel().eval()


@pytest.fixture
def pinhole_with_dyfn() -> PinholeModel:
    return PinholeModel(stabilized=True).eval()


@pytest.fixture(scope="session")
def small_moge() -> MoGeModel:
    """A MoGe with random weights and DyFN whose heads do something; not to be changed."""
    torch.manual_seed(0)
    config = MoGeConfig(
        encoder="dinov2_vits14",
        dim_proj=32,
        dim_upsample=(32, 32, 32),
        remap_output="exp",
        num_tokens_range=(6, 12),
    )
    model = MoGeModel(config)
    model.stabilizer = build_dyfn(32, DyFNConfig(hidden=8))
    heads = model.stabilizer.gamma_head, model.stabilizer.beta_head
    redraw((head.weight for head in heads), 0.5, seed=0)
    torch.nn.init.ones_(model.head.output_block[1][-1].bias)  # a mask that is mostly True
    return model.eval()


@pytest.fixture(scope="module")
def renderer() -> Any:
    """A Renderer of small_camera.SIZE; skips without OpenGL."""
    from dyfn_worlds.render.renderer import Renderer
    from tests.support.small_camera import SIZE

    try:
        return Renderer(SIZE)
    except Exception as error:
        pytest.skip(f"no headless OpenGL on this machine: {error}")
