"""/tf for a node in this process, where tf2_msgs is not installed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from geometry_msgs.msg import TransformStamped

from tests.support.odometry import use_tf_stand_in


@contextmanager
def tf_stand_in() -> Iterator[None]:
    """See use_tf_stand_in; other tests of this process do not see it."""
    with patch.dict(sys.modules):
        use_tf_stand_in()
        try:
            yield
        finally:
            if "transforms" in vars(TransformStamped):
                del TransformStamped.transforms
