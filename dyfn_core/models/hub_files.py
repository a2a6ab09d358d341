"""Hub ids -> files on this machine, downloaded if need be; refusals come before downloads."""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any, TypeVar, cast

from dyfn_core.models.formats import CheckpointError

logger = logging.getLogger(__name__)

# Hub id, and its file with the weights.
SUPPORTED = {
    "Ruicheng/moge-vitl": "model.pt",
    "Ruicheng/moge-2-vitl": "model.pt",
    "Ruicheng/moge-2-vitl-normal": "model.pt",
    "Ruicheng/moge-2-vitb-normal": "model.pt",
    "Ruicheng/moge-2-vits-normal": "model.pt",
    "shawlyu/DyFN": "DyFN.pt",
    "depth-anything/Depth-Anything-V2-Small": "depth_anything_v2_vits.pth",
    "depth-anything/Depth-Anything-V2-Base": "depth_anything_v2_vitb.pth",
    "depth-anything/Depth-Anything-V2-Large": "depth_anything_v2_vitl.pth",
    "depth-anything/DA3MONO-LARGE": "model.safetensors",
    "depth-anything/DA3METRIC-LARGE": "model.safetensors",
}
_FILES = {repo.lower(): file for repo, file in SUPPORTED.items()}
# Of whom the name of a repository tells what is in it, and what that is.
_UNSUPPORTED = (
    (r"depth-anything/da3.*", "Depth Anything 3 for several views"),
    (r"depth-anything/depth-anything-v2-.*-hf", "Depth Anything V2 in the format of transformers"),
    (r"depth-anything/depth-anything-v2-metric-.*", "metric Depth Anything V2"),
    (r"depth-anything/video-depth-anything-.*", "Video Depth Anything"),
    (r"depth-anything/.*", "another model of Depth Anything"),
    (r"liheyoung/.*", "Depth Anything V1"),
    (r"ruicheng/moge-2.*", "another MoGe v2"),
    (r"ruicheng/moge-3.*", "MoGe v3"),
    (r"ruicheng/.*", "another MoGe"),
)
WEIGHTS, CONFIG = "model.safetensors", "config.json"  # in repositories of models of this project
LIBRARY = "dyfn_ros"  # in their config.json
ANSWER = 4.0  # seconds that the Hub has to answer
MOST_FILES = 8  # of a repository that a message lists
Answer = TypeVar("Answer")

_HUB_ID = re.compile(r"(?P<repo>[\w.-]+/[\w.-]+)(/(?P<file>.+))?")


def is_hub_id(name: str) -> bool:
    """Whether a name has the form owner/name, or owner/name/file."""
    return _HUB_ID.fullmatch(name) is not None


def model_folder() -> Path:
    """Where files downloaded by hand are looked for: $DYFN_MODELS or ~/.cache/dyfn/models."""
    chosen = os.environ.get("DYFN_MODELS")
    return Path(chosen) if chosen else Path.home() / ".cache" / "dyfn" / "models"


@dataclass(frozen=True)
class Asked:
    """How the Hub and its cache are asked, in huggingface_hub's words.

    Attributes:
        revision: Branch, tag or commit; None: what the cache has of main, else main.
        cache_dir: Folder of the cache; None: huggingface_hub's own.
        token: Access token; None: the one that is logged in, False: none.
        local_files_only: Nothing but the cache is asked.
        force_download: The cache is not asked.
    """

    revision: str | None = None
    cache_dir: str | Path | None = None
    token: str | bool | None = None
    local_files_only: bool = False
    force_download: bool = False

    @property
    def by_hand(self) -> bool:
        """Whether a file put there by hand, of an unknown revision, will do."""
        return self.revision is None and not self.force_download


def locate(name: str, asked: Asked | None = None) -> Path:
    """The file with a Hub model's weights, on this machine.

    Args:
        name: See is_hub_id.
        asked: How; None: by the defaults.

    Raises:
        CheckpointError: The repository holds something that is not supported; nothing but its
            config.json, a small file, has been downloaded then.
        FileNotFoundError: No such file, or no network; says what to put where.
    """
    repo, file = hub_parts(name)
    asked = asked or Asked()
    known = _FILES.get(repo.lower())
    if known is None:
        _refuse_by_name(repo)
    if file or known:
        return fetch(repo, file or known or "", asked=asked)
    by_hand = model_folder() / repo
    for one in (by_hand / WEIGHTS, by_hand / "model.pt"):
        if asked.by_hand and one.is_file():
            return one
    _refuse_by_config(repo, fetch(repo, CONFIG, wanted=WEIGHTS, asked=asked))
    return fetch(repo, WEIGHTS, asked=asked)


def hub_parts(name: str) -> tuple[str, str]:
    """owner/name/file -> owner/name and the file, "" for none. name: see is_hub_id."""
    match = _HUB_ID.fullmatch(name)
    assert match is not None, name
    return match["repo"], match["file"] or ""


def _refuse_by_name(repo: str) -> None:
    for pattern, what in _UNSUPPORTED:
        if re.fullmatch(pattern, repo.lower()):
            raise CheckpointError(f"Hub model {repo} is {what}: not supported; {_choice()}")


def _refuse_by_config(repo: str, path: Path) -> None:
    """Raises CheckpointError unless config.json is that of a model of this project."""
    try:
        found: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointError(f"Hub model {repo}: its {CONFIG} is no JSON: {error}") from error
    if isinstance(found, dict) and found.get("library") == LIBRARY:
        return
    keys = ("library", "model_type", "model_name", "architectures", "_class_name")
    said = {key: found[key] for key in keys if isinstance(found, dict) and key in found}
    raise CheckpointError(
        f"Hub model {repo} is not supported: its {CONFIG} says {said or 'nothing of a model'}; "
        f"{_choice()}. {_by_file(repo)}"
    )


def _choice() -> str:
    return "supported are " + ", ".join(SUPPORTED)


def _by_file(repo: str) -> str:
    return f"A checkpoint in a supported format is named with its file: {repo}/FILE"


def fetch(repo: str, file: str, wanted: str = "", asked: Asked | None = None) -> Path:
    """A repository's file: put there by hand, in the Hub's cache, or downloaded.

    wanted: what to put by hand where this file cannot be had; "" is the file itself.
    """
    asked = asked or Asked()
    by_hand = model_folder() / repo / file
    if asked.by_hand and by_hand.is_file():
        return by_hand
    from huggingface_hub import hf_hub_download, try_to_load_from_cache
    from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError

    cached = try_to_load_from_cache(repo, file, cache_dir=asked.cache_dir, revision=asked.revision)
    if isinstance(cached, str) and not asked.force_download:
        return Path(cached)
    try:
        if not asked.local_files_only:
            logger.info("fetching %s of %s from the Hub", file, repo)
            _ask(repo, file, asked)
        return Path(
            hf_hub_download(repo_id=repo, filename=file, etag_timeout=ANSWER, **asdict(asked))
        )
    except Exception as error:  # many kinds, by version: no network, no such file, no access
        absent = isinstance(error, EntryNotFoundError)
        if wanted and absent and not isinstance(error, LocalEntryNotFoundError):
            raise CheckpointError(
                f"Hub model {repo} is not supported: it has no {file} that says what it is"
                f"{_listed(repo, asked)}; {_choice()}. {_by_file(repo)}"
            ) from error
        raise FileNotFoundError(_unavailable(repo, wanted or file, asked, error)) from error


def _ask(repo: str, file: str, asked: Asked) -> None:
    """Raises what the Hub answers, or TimeoutError, within ANSWER seconds."""
    from huggingface_hub import constants, get_hf_file_metadata, hf_hub_url

    if constants.HF_HUB_OFFLINE:
        return  # huggingface_hub says so itself
    url = hf_hub_url(repo, file, revision=asked.revision)
    _answered(url, lambda: get_hf_file_metadata(url, token=asked.token, timeout=ANSWER))


def _listed(repo: str, asked: Asked) -> str:
    """The names of a repository's files, as the end of a sentence; "" when they cannot be had."""
    from huggingface_hub import HfApi

    api = HfApi(token=asked.token)
    try:
        names = _answered(repo, lambda: api.list_repo_files(repo, revision=asked.revision))
    except Exception:  # the refusal stands without it
        return ""
    shown = [name for name in sorted(names) if not name.startswith(".")]
    more = f" and {len(shown) - MOST_FILES} more" if len(shown) > MOST_FILES else ""
    return f"; it has {', '.join(shown[:MOST_FILES])}{more}" if shown else ""


def _answered(what: str, question: Callable[[], Answer]) -> Answer:
    """What a question to the Hub gives or raises, or TimeoutError, within ANSWER seconds.

    Without a network hf_hub_download tries again for 25 s, and the timeout of a connection bounds
    neither the resolution of a name nor the trial of all addresses behind it.
    """
    answers: SimpleQueue[tuple[Answer | None, Exception | None]] = SimpleQueue()

    def ask() -> None:
        try:
            answers.put((question(), None))
        except Exception as error:  # handed to the caller's thread
            answers.put((None, error))

    Thread(target=ask, daemon=True).start()
    try:
        answer, error = answers.get(timeout=ANSWER)
    except Empty:
        raise TimeoutError(f"no answer within {ANSWER:g} s from {what}") from None
    if error is not None:
        raise error
    return cast(Answer, answer)


def _unavailable(repo: str, file: str, asked: Asked, error: Exception) -> str:
    from huggingface_hub import constants, hf_hub_url

    cache = asked.cache_dir or constants.HF_HUB_CACHE
    revision = "" if asked.revision is None else f" at revision {asked.revision}"
    if asked.local_files_only:
        return (
            f"no {file} of Hub model {repo}{revision} in the cache {cache}, and local_files_only "
            "forbids to ask the Hub"
        )
    here = model_folder() / repo / file
    put = f"put it at {here} (or anywhere, and pass its path)" if asked.by_hand else "pass its path"
    why = f"{type(error).__name__}: {error}"
    if constants.HF_HUB_OFFLINE:
        why = "HF_HUB_OFFLINE is set, which forbids to ask the Hub"
    return (
        f"no such file here, and cannot download {file} of Hub model {repo}{revision} ({why}). "
        f"Download {hf_hub_url(repo, file, revision=asked.revision)} on a machine with a network "
        f"and {put}. The Hub's cache is {cache}"
    )
