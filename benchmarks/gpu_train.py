"""Renders, trains the base and DyFN, and packs the result, all within a given time on a GPU.

    make gpu-train GPU_TRAIN="--art out/art --recordings RECORDINGS --minutes 10"

For a machine that is lent for minutes. The base goes on from --start in bf16, on new views and, if
given, on photographs with depth; DyFN is moved to it and goes on from new walks. OUT gets
base.safetensors and model.safetensors (float16) and times.json. --device cpu tries all of it.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dyfn_core.models.checkpoints import load_model, save_model
from dyfn_worlds.maps.quake import GameFiles

ROOT = Path(__file__).resolve().parents[1]
BASE_CONFIG = ROOT / "config/train_base_mini_real.yaml"
DYFN_CONFIG = ROOT / "config/train_dyfn_mini_more.yaml"
START = ROOT / "dyfn_core/weights/dyfn-mini-9.safetensors"
BUDGET = 64e6  # bytes that may be carried: the code, two models, the art and the recordings
NEEDED = ("dyfn_core", "dyfn_worlds", "config", "benchmarks")
# of the whole time; the rest is for starting processes, averaging, moving and packing
SHARES = {"render": 0.25, "base": 0.42, "first_dyfn": 0.06, "dyfn": 0.15}
FIRST_DRAWS = 32  # clips by which the speed is known
OWN_SHARE = 0.75  # of the new base in the mean with the one it started from
WALK = ["--clip-frames", "24", "--clip-fps", "2.5"]
# folder below data/, options of dyfn-worlds, share of the processes that render
KINDS: tuple[tuple[str, list[str], int], ...] = (
    ("rooms_usual", ["--worlds", "rooms", "--views", "40"], 4),
    ("clips_rooms", ["--worlds", "rooms", *WALK], 3),
    ("maps_usual", ["--worlds", "maps", "--views", "24"], 2),
    ("base_walks_rooms", ["--worlds", "rooms", "--clip-frames", "10", "--clip-fps", "1"], 2),
    ("clips_maps", ["--worlds", "maps", *WALK], 1),
    ("rooms_close", ["--worlds", "rooms", "--views", "32", "--placement", "close"], 1),
    ("rooms_steep", ["--worlds", "rooms", "--views", "32", "--placement", "steep"], 1),
    ("clips_turning", ["--worlds", "rooms", *WALK, "--pace", "turning"], 1),
    ("clips_static", ["--worlds", "rooms", *WALK, "--pace", "static"], 1),
)


@dataclass(frozen=True)
class Sizes:
    """What depends on the machine: processes, images of a step and of one of its parts."""

    workers: int
    part: int

    @property
    def batch(self) -> int:
        """One loader for each part, so that augmentation has a core for each."""
        return self.part * self.workers


def renderers(art: Path, data: Path, workers: int, samples: int) -> list[list[str]]:
    """A command for each process: the kinds by their shares, each with seeds of its own."""
    archives = sorted(art.rglob("*.pk3"))
    maps = bool(archives and GameFiles(archives).maps())
    kinds = [(f, o) for f, o, share in KINDS if maps or "maps" not in o for _ in range(share)]
    kinds = _spread(kinds, workers)
    commands = []
    for number, (folder, options) in enumerate(kinds):
        where = ["--assets", str(art), "--out", str(data / folder), "--samples", str(samples)]
        # a seed that ends in 0 is held out
        count = ["--shards", "100000", "--seed", str(1 + 1_000_000 * (number + 2))]
        commands.append([sys.executable, "-m", "dyfn_worlds.cli", *where, *options, *count])
    return commands


def _spread(kinds: list[tuple[str, list[str]]], workers: int) -> list[tuple[str, list[str]]]:
    """As many as there are workers: evenly chosen, or all and more of them in turn."""
    if workers >= len(kinds):
        return [kinds[i % len(kinds)] for i in range(workers)]
    return [kinds[i * len(kinds) // workers] for i in range(workers)]


def known_data(config: dict[str, Any], data: Path) -> list[dict[str, Any]]:
    """The config's data sets that lie below `data`, as the config weighs them.

    Raises FileNotFoundError when there is none to train on.
    """
    found = [
        {**spec, "root": str(data / Path(spec["root"]).relative_to("data"))}
        for spec in config["data"]
    ]
    kept = [spec for spec in found if Path(spec["root"]).is_dir()]
    if not any(spec.get("split") != "held_out" for spec in kept):
        raise FileNotFoundError(f"{data}: none of the data sets of {BASE_CONFIG.name} is there")
    missing = [Path(spec["root"]).name for spec in found if spec not in kept]
    if missing:
        print(f"without {', '.join(missing)}, which are not there", flush=True)
    return kept


def base_command(options: argparse.Namespace, work: Path, seconds: float) -> list[str]:
    """The base's run, in bf16, ended by the clock."""
    config = yaml.safe_load(BASE_CONFIG.read_text())
    sizes, stage = options.sizes, config["stages"][0]
    settings = {
        "data": known_data(config, work / "data"),
        "stages": [{**stage, "batch": sizes.batch}],
        "initial": str(options.start),
        "hours": seconds / 3600,
        "parts": sizes.workers,
        "mixed_precision": "bf16",
        "device": _device(options),
        "validate_every": 100_000,  # its time is the training's
    }
    return _train("base", BASE_CONFIG, work / "base", settings)


def dyfn_command(
    options: argparse.Namespace, work: Path, base: Path, out: str, draws: int, steps: int
) -> list[str]:
    """DyFN's run on walks that the base has not seen; all runs share one cache.

    Raises FileNotFoundError when there is no walk.
    """
    metas = (work / "data").glob("clips_*/clips/*/meta.json")  # of finished walks
    roots = sorted({str(meta.parents[2]) for meta in metas})
    if not roots:
        raise FileNotFoundError(
            f"{work / 'data'}: no walk was finished in the time: more --minutes, fewer --samples"
        )
    settings = {
        "base": str(base),
        "data": roots,
        "method.gru_input_draws": draws,
        "method.cache": str(work / "gru_inputs"),
        "steps": steps,
        "validate_every": steps,
        "validation_clips": 4,
        "device": _device(options),
    }
    return _train("dyfn", DYFN_CONFIG, work / out, settings)


def _train(kind: str, config: Path, out: Path, settings: dict[str, Any]) -> list[str]:
    sets = [f"--set={name}={json.dumps(value)}" for name, value in settings.items()]
    return [
        sys.executable,
        "-m",
        "dyfn_core.cli.train",
        kind,
        str(config),
        "--out",
        str(out),
        *sets,
    ]


def _device(options: argparse.Namespace) -> str:
    return "cpu" if options.device == "cpu" else "auto"


def render(commands: Sequence[list[str]], seconds: float, logs: Path) -> None:
    """Runs the commands side by side and stops them after so long; finished shards stay.

    Raises RuntimeError with the log of one that failed.
    """
    logs.mkdir(parents=True, exist_ok=True)
    running = []
    for number, command in enumerate(commands):
        log = (logs / f"render_{number}.log").open("wb")
        running.append((subprocess.Popen(command, stdout=log, stderr=log), log))
    end = time.monotonic() + seconds
    while time.monotonic() < end and all(process.poll() is None for process, _ in running):
        time.sleep(0.2)
    for process, _ in running:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    for number, (process, log) in enumerate(running):
        code = process.wait()
        log.close()
        if code not in (0, 130):
            told = (logs / f"render_{number}.log").read_text(errors="replace")[-2000:]
            raise RuntimeError(f"{' '.join(commands[number])} ended with {code}:\n{told}")


def tell_renderer(cpu: bool) -> str:
    """What draws. Raises RuntimeError when a GPU was asked for and EGL gives a CPU's rasteriser."""
    import moderngl

    context = moderngl.create_context(standalone=True, **{"backend": "egl"})  # type: ignore[arg-type]
    name = str(context.info["GL_RENDERER"])
    context.release()
    if not cpu and any(word in name.lower() for word in ("llvmpipe", "softpipe", "swrast")):
        raise RuntimeError(
            f"EGL draws with {name}, on the CPU: name the GPU's driver in "
            "__EGL_VENDOR_LIBRARY_FILENAMES, or pass --device cpu"
        )
    return name


def check_size(weights: Sequence[Path], folders: Sequence[Path]) -> float:
    """Bytes of the packages, configs and scripts here, of these weights and of the folders.

    Raises ValueError when they are more than BUDGET.
    """
    files = [path for name in NEEDED for path in (ROOT / name).rglob("*")]
    files = [path for path in files if path.suffix in (".py", ".yaml", ".json", ".md")]
    files += [*weights, *(path for folder in folders for path in folder.rglob("*"))]
    total = float(sum(path.stat().st_size for path in files if path.is_file()))
    if total > BUDGET:
        raise ValueError(
            f"{total / 1e6:.1f} MB to carry, more than {BUDGET / 1e6:.0f}: pack less art "
            "(benchmarks/pack_art.py --megabytes) or fewer recordings"
        )
    return total


def train(options: argparse.Namespace) -> dict[str, Any]:
    """The whole of it; returns what took how long, and how much was made."""
    began = time.monotonic()
    report: dict[str, Any] = {
        "carried_megabytes": check_size([options.start, options.dyfn], _folders(options)) / 1e6
    }
    report["renderer"] = tell_renderer(options.device == "cpu")
    print(f"{report['renderer']} draws, {options.sizes.workers} processes", flush=True)
    work, whole = options.work, 60 * options.minutes
    shutil.rmtree(work, ignore_errors=True)
    options.out.mkdir(parents=True, exist_ok=True)

    def timed(name: str, *commands: list[str]) -> float:
        start = time.monotonic()
        for command in commands:
            subprocess.run(command, check=True, cwd=ROOT)
        report[f"{name}_seconds"] = round(time.monotonic() - start, 1)
        return time.monotonic() - start

    if options.recordings:
        timed("split", _script("split_recordings", options.recordings, work / "data/real"))
    start = time.monotonic()
    commands = renderers(options.art, work / "data", options.sizes.workers, options.samples)
    render(commands, SHARES["render"] * whole, work)
    report["render_seconds"] = round(time.monotonic() - start, 1)
    report["frames"] = {p.name: len(list(p.rglob("*.jpg"))) for p in _rendered(work)}
    print(json.dumps(report["frames"]), flush=True)
    timed("base", base_command(options, work, SHARES["base"] * whole))
    report["images"] = json.loads((work / "base/results.json").read_text())["images"]
    mean, moved = work / "mean.safetensors", work / "moved.safetensors"
    shares = ["--shares", str(1 - OWN_SHARE), str(OWN_SHARE), "--out", str(mean)]
    models = [str(options.start), str(work / "base/model.safetensors")]
    images = ["--images", *map(str, _rendered(work)), "--count", "80"]
    timed(
        "move",
        [sys.executable, "-m", "dyfn_core.cli.train", "average", *models, *shares],
        [*_script("move_dyfn", options.dyfn, mean), "--out", str(moved), *images],
    )
    first = timed("first_dyfn", dyfn_command(options, work, moved, "first", FIRST_DRAWS, 20))
    left = whole - (time.monotonic() - began)
    draws = more_draws(first, min(left, SHARES["dyfn"] * whole), options.draws)
    report["draws"] = draws
    timed("dyfn", dyfn_command(options, work, work / "first/model.safetensors", "dyfn", draws, 200))
    save_model(load_model(str(mean)), options.out / "base.safetensors", _half())
    result = load_model(str(work / "dyfn/best.safetensors"))
    save_model(result, options.out / "model.safetensors", _half())
    report["seconds"] = round(time.monotonic() - began, 1)
    (options.out / "times.json").write_text(json.dumps(report, indent=1) + "\n")
    return report


def more_draws(first_seconds: float, seconds: float, most: int) -> int:
    """Clips that can be summarised in the time, by how long the first ones took."""
    return int(min(most, max(FIRST_DRAWS, FIRST_DRAWS * (1 + 0.7 * seconds / first_seconds))))


def _rendered(work: Path) -> list[Path]:
    return sorted(p for p in (work / "data").iterdir() if p.name != "real")


def _folders(options: argparse.Namespace) -> list[Path]:
    return [options.art, *([options.recordings] if options.recordings else [])]


def _script(name: str, *arguments: object) -> list[str]:
    return [sys.executable, str(ROOT / f"benchmarks/{name}.py"), *map(str, arguments)]


def _half() -> Any:
    import torch

    return torch.float16


def parsed(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line, with the sizes that follow from it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add = parser.add_argument
    add("--art", type=Path, required=True, help="art to render from (benchmarks/pack_art.py)")
    add("--recordings", type=Path, help="folders of real pictures with depth to train on too")
    add("--out", type=Path, default=ROOT / "out/gpu", help="of the result (default: out/gpu)")
    add("--work", type=Path, default=ROOT / "runs/gpu", help="made anew (default: runs/gpu)")
    add("--start", type=Path, default=START, help=f"base to go on from (default: {START.name})")
    add("--dyfn", type=Path, default=START, help="model whose DyFN is moved to the new base")
    add("--minutes", type=float, default=10.0, help="for all of it (default: 10)")
    add("--workers", type=int, default=max(2, (os.cpu_count() or 2) - 2), help="processes")
    add("--part", type=int, default=16, help="images for each process in a step (default: 16)")
    add("--samples", type=int, default=4, help="of dyfn-worlds (default: 4)")
    add("--draws", type=int, default=3000, help="clips for DyFN, at most (default: 3000)")
    add("--device", choices=("cuda", "cpu"), default="cuda")
    options = parser.parse_args(arguments)
    options.sizes = Sizes(options.workers, options.part)
    return options


def main() -> int:
    try:
        report = train(parsed())
    except (OSError, ValueError, RuntimeError, subprocess.CalledProcessError) as error:
        print(f"gpu_train: {error}", file=sys.stderr)
        return 1
    print(json.dumps(report, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
