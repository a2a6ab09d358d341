"""dyfn-train: train the small model's base, or DyFN on top of it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dyfn_core.training.base import BaseTask
from dyfn_core.training.config import BaseRunConfig, ConfigError, read_config
from dyfn_core.training.trainer import Trainer, TrainingError


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = _parser().parse_args(arguments)
    try:
        config = read_config(options.config, BaseRunConfig, options.set)
        trainer = Trainer(BaseTask(config), config, options.out, options.resume)
        trainer.train(options.max_steps)
    except (ConfigError, TrainingError, FileNotFoundError, ValueError) as error:
        print(f"dyfn-train: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("dyfn-train: interrupted; the last checkpoint can be resumed", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="dyfn-train", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, purpose in (("base", "train encoder and head on rendered frames"),):
        command = commands.add_parser(name, help=purpose, description=purpose)
        command.add_argument("config", type=Path, help="YAML file with the run's settings")
        command.add_argument("--out", type=Path, required=True, help="folder of the run")
        command.add_argument("--resume", action="store_true", help="go on from OUT/state.pt")
        command.add_argument("--max-steps", type=int, help="stop at this step")
        command.add_argument(
            "--set", action="append", default=[], metavar="KEY=VALUE", help="override a setting"
        )
    return parser


if __name__ == "__main__":
    sys.exit(main())
