"""Entry point of `dyfn-worlds`: a renderer's library that is missing ends in one line."""

import sys


def main() -> int:
    """`dyfn-worlds`."""
    try:
        from dyfn_worlds.cli import main as worlds

        return worlds()
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("dyfn_"):
            raise
        told = f"{error.name} is not installed: pip install 'dyfn_ros[worlds]'"
        print(f"dyfn-worlds: {told}", file=sys.stderr)
        return 2
