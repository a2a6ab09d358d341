"""Models as folders and as repositories of the Hugging Face Hub."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import yaml
from huggingface_hub import ModelCard, ModelHubMixin

from dyfn_core.files import write_text
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import (
    BUNDLED,
    FORMAT,
    build_model,
    find_checkpoint,
    full_config,
    load_model,
    save_model,
)
from dyfn_core.models.device import resolve_device
from dyfn_core.models.formats import Checkpoint, CheckpointError, read_checkpoint
from dyfn_core.models.hub_files import (
    CONFIG,
    LIBRARY,
    SUPPORTED,
    WEIGHTS,
    Asked,
    hub_parts,
    is_hub_id,
)
from dyfn_core.models.model_card import ModelFacts, license_of, model_card, read_facts, run_facts

RUN_CONFIG, RUN_RESULTS = "config.yaml", "results.json"  # of a run of dyfn-train
FORMATS = (f"{FORMAT} 1",)
ENTRIES = ("library", "format", "model", "facts")  # of config.json


class DyFNModel(ModelHubMixin, library_name=LIBRARY):
    """A model with what is known of it, as a folder or a repository of the Hugging Face Hub.

    A folder has `model.safetensors`, which `load_model` reads as well, `config.json` and the model
    card `README.md`. The weights are kept bit for bit.

    Attributes:
        model: The model; what `DepthStream` and `StreamSession` take.
        facts: What its card says besides.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     _ = DyFNModel.from_pretrained("dyfn-mini").save_pretrained(folder)
        ...     again = DyFNModel.from_pretrained(folder)
        >>> again.model.quantity, again.facts.license
        ('depth', 'apache-2.0')
    """

    def __init__(self, model: GeometryModel, facts: ModelFacts | None = None) -> None:
        """A model that is here.

        Args:
            model: The model.
            facts: What its card says besides. A licence that is left out is that of the base, if
                it is known.
        """
        given = facts or ModelFacts()
        self.model = model
        self.facts = replace(given, license=license_of(model, given))

    @classmethod
    def from_pretrained(  # type: ignore[override]  # other keywords are refused
        cls,
        pretrained_model_name_or_path: str | Path,
        *,
        device: torch.device | str = "cpu",
        force_download: bool = False,
        token: str | bool | None = None,
        cache_dir: str | Path | None = None,
        local_files_only: bool = False,
        revision: str | None = None,
    ) -> DyFNModel:
        """A model from a folder, a file or the Hub.

        What the cache has is used without asking the Hub. Without a network and without the file
        in the cache this is answered within 5 seconds.

        Args:
            pretrained_model_name_or_path: A folder of `save_pretrained` or of a run of
                `dyfn-train`; or what `load_model` takes: a file, a bundled model, a Hub id.
            device: As for `load_model`.
            force_download: Download again what the cache has.
            token: Access token; None takes the one that is logged in, False none.
            cache_dir: Folder of the Hub's cache.
            local_files_only: Use the cache and ask nobody.
            revision: Branch, tag or commit; None: what the cache has of main, else main.

        Returns:
            The model in eval mode, float32, with what is known of it.

        Raises:
            FileNotFoundError: No such file or folder, or no network; names the cache.
            CheckpointError: A configuration is missing, foreign or wrong, or does not fit the
                weights; names file and entry.
            ValueError: No such device.
        """
        name = str(pretrained_model_name_or_path)
        asked = Asked(revision, cache_dir, token, local_files_only, force_download)
        if name in BUNDLED and not Path(name).exists():
            return cls(load_model(name, device))
        folder = Path(name).expanduser()
        facts = _run_facts(folder) if _is_run(folder) else None
        path = find_checkpoint(name, asked)
        if folder.is_dir() and facts is None and not (folder / CONFIG).is_file():
            raise CheckpointError(
                f"{folder} has neither a {CONFIG}, as save_pretrained writes it, nor a "
                f"{RUN_CONFIG} of a run of dyfn-train"
            )
        checkpoint = read_checkpoint(path)
        if facts is None and not folder.exists() and _release(name):
            facts = ModelFacts(base_model=_release(name))
        if facts is None:
            facts = _facts(path, checkpoint)
        model = build_model(checkpoint, str(path)).to(resolve_device(device))
        return cls(model, facts)

    def push_to_hub(self, repo_id: str, **options: Any) -> str:
        """Upload weights, config.json and model card in one commit.

        Args:
            repo_id: owner/name; the repository is made if it is not there.
            options: `commit_message`, `private`, `token`, `branch`, `create_pr`, and the other
                keywords of huggingface_hub's `ModelHubMixin.push_to_hub`.

        Returns:
            Address of the commit.
        """
        more = {"repo_id": repo_id, **(options.pop("model_card_kwargs", None) or {})}
        told: str = super().push_to_hub(repo_id, model_card_kwargs=more, **options)
        return told

    def generate_model_card(self, repo_id: str = "") -> ModelCard:
        """The model card.

        Args:
            repo_id: Where the model is or will be on the Hub; "": not known.

        Returns:
            The card; `save` writes it, `content` is its text.
        """
        return model_card(self.model, self.facts, repo_id)

    def _save_pretrained(self, save_directory: Path) -> None:
        """What the mixin's save_pretrained calls, before it writes the card if there is none."""
        save_model(self.model, save_directory / WEIGHTS)
        said = (LIBRARY, FORMATS[-1], full_config(self.model), self.facts.to_dict())
        text = json.dumps(dict(zip(ENTRIES, said, strict=True)), indent=2, allow_nan=False)
        write_text(save_directory / CONFIG, text + "\n")


def _release(name: str) -> str:
    """The released repository that a Hub id means; "" for another one."""
    released = {repo.lower(): repo for repo in SUPPORTED}
    return released.get(hub_parts(name)[0].lower(), "") if is_hub_id(name) else ""


def _facts(path: Path, checkpoint: Checkpoint) -> ModelFacts:
    """From config.json beside the weights; without one, what the weights' file notes."""
    beside = path.with_name(CONFIG)
    if path.name != WEIGHTS or checkpoint.official or not beside.is_file():
        notes = dict(checkpoint.notes)
        return ModelFacts(base_model=notes.pop("adapted_from", ""), training=notes)
    found = _json_object(beside)
    if found.get("library") != LIBRARY:
        raise CheckpointError(
            f"{beside} is of another library: `library` is {found.get('library')!r}, expected "
            f"{LIBRARY!r}"
        )
    wrong = [f"{key} is missing" for key in ENTRIES if key not in found]
    wrong += [f"{key} is unknown" for key in found if key not in ENTRIES]
    if wrong:
        raise CheckpointError(f"{beside}: {', '.join(wrong)}; expected {', '.join(ENTRIES)}")
    if found["format"] not in FORMATS:
        raise CheckpointError(
            f"{beside}: format {found['format']!r} is not supported, expected one of {FORMATS}; "
            "a newer dyfn_ros may have written it"
        )
    _check_same(found["model"], checkpoint.config, beside)
    return read_facts(found["facts"], f"{beside}, facts")


def _check_same(said: Any, config: Mapping[str, Any], beside: Path) -> None:
    """Whether config.json and the metadata of the weights describe one model."""
    own = json.loads(json.dumps(config))
    if said == own:
        return
    values = said if isinstance(said, dict) else {}
    other = [key for key in sorted({*own, *values}) if own.get(key) != values.get(key)]
    told = ", ".join(f"{key}: {values.get(key)!r} / {own.get(key)!r}" for key in other)
    raise CheckpointError(
        f"{beside} describes another model than {WEIGHTS} beside it ({CONFIG} / {WEIGHTS}): {told}"
    )


def _is_run(folder: Path) -> bool:
    return (folder / RUN_CONFIG).is_file() and not (folder / CONFIG).exists()


def _run_facts(folder: Path) -> ModelFacts:
    """Of a run of dyfn-train: its settings, and its results once it is over."""
    path = folder / RUN_CONFIG
    try:
        config = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise CheckpointError(f"{path} is no YAML: {error}") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{path} has no settings of a run: {type(config).__name__}")
    results = folder / RUN_RESULTS
    return run_facts(config, _json_object(results) if results.is_file() else {})


def _json_object(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} is no JSON: {error}") from error
    if not isinstance(found, dict):
        raise CheckpointError(f"{path} is no JSON object")
    return found
