"""Entry points of the commands: imports of an extra that is missing end in one line."""

from dyfn_core.extras import start


def depth() -> int:
    """`dyfn-depth`."""
    return start("dyfn-depth", "dyfn_ros.depth.cli")


def app() -> int:
    """`dyfn-app`."""
    return start("dyfn-app", "dyfn_ros.app.cli")


def replay() -> int:
    """`dyfn-replay`."""
    return start("dyfn-replay", "dyfn_ros.replay.cli")


def record() -> int:
    """`dyfn-record`."""
    return start("dyfn-record", "dyfn_ros.record.cli")


def demo() -> int:
    """`dyfn-demo`."""
    return start("dyfn-demo", "dyfn_ros.demo.cli")


def stream_depth() -> int:
    """`stream_depth`, the node."""
    return start("stream_depth", "dyfn_ros.node.main")
