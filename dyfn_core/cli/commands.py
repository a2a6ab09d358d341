"""Entry points of the commands: imports of an extra that is missing end in one line."""

from dyfn_core.extras import start


def train() -> int:
    """`dyfn-train`."""
    return start("dyfn-train", "dyfn_core.cli.train")


def export() -> int:
    """`dyfn-export`."""
    return start("dyfn-export", "dyfn_core.cli.export")


def evaluate() -> int:
    """`dyfn-eval`."""
    return start("dyfn-eval", "dyfn_core.cli.eval")
