"""What is known of a model besides its weights, and the model card that says it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from pydantic import ConfigDict, TypeAdapter, ValidationError

from dyfn_core.models.base import GeometryModel
from dyfn_core.models.formats import CheckpointError
from dyfn_core.models.hub_files import LIBRARY, is_hub_id
from dyfn_core.quantities import AFFINE_DEPTH, DEPTH, DISPARITY

if TYPE_CHECKING:
    from huggingface_hub import ModelCard

APACHE = "apache-2.0"
# Of released weights, as their pages said; a repository that is not here says it itself.
LICENSES = {
    "Ruicheng/moge-vitl": APACHE,
    "Ruicheng/moge-2-vitl": "mit",
    "Ruicheng/moge-2-vitl-normal": "mit",
    "Ruicheng/moge-2-vitb-normal": "mit",
    "Ruicheng/moge-2-vits-normal": "mit",
    "depth-anything/Depth-Anything-V2-Small": APACHE,
    "depth-anything/Depth-Anything-V2-Base": "cc-by-nc-4.0",
    "depth-anything/Depth-Anything-V2-Large": "cc-by-nc-4.0",
    "depth-anything/DA3MONO-LARGE": APACHE,
    "depth-anything/DA3METRIC-LARGE": APACHE,
}
PAPER = "2605.25308"
PIPELINE = "depth-estimation"
# What of a run's results.json counts and scores nothing.
COUNTERS = (
    *("step", "seconds", "images", "best", "stale", "bad_steps", "skipped_steps"),
    "unreadable_clips",
)
_TRAINED = {"step": "trained_steps", "seconds": "trained_seconds", "images": "trained_images"}
_QUANTITIES = {
    DEPTH: "depth up to one scale for a stream",
    AFFINE_DEPTH: "depth up to one scale and one shift for a stream",
    DISPARITY: "disparity up to one scale and one shift for a stream",
}
# A folder in front of a name: what a card says of files does not tell whose machine had them.
_FOLDERS = re.compile(r"(?:~|\.{1,2})?(?:[^\s/=,{}\[\]:'\"]*/)+(?=[^\s/])")


@dataclass(frozen=True)
class ModelFacts:
    """What a model card says of a model besides what the model itself says.

    Attributes:
        license: Hub's name of the licence, as "apache-2.0"; "": not known, or that of the base.
        base_model: Hub id or name of the model that this one was made from; "": none.
        data: Names of the data that it was trained on.
        training: Settings of the training.
        metrics: Scores by name.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", strict=False)

    license: str = ""
    base_model: str = ""
    data: tuple[str, ...] = ()
    training: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The facts as JSON has them.

        Returns:
            JSON-able values by attribute.
        """
        return {**asdict(self), "data": list(self.data)}


_FACTS = TypeAdapter(ModelFacts)


def read_facts(values: Any, source: str) -> ModelFacts:
    """What to_dict gave. Raises CheckpointError that names `source` and every wrong entry."""
    try:
        return _FACTS.validate_python(values)
    except ValidationError as error:
        wrong = [f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        raise CheckpointError(f"{source}: {'; '.join(wrong)}") from error


def license_of(model: GeometryModel, facts: ModelFacts) -> str:
    """The licence as far as it is known: given, the base's, or this project's own."""
    if facts.license:
        return facts.license
    if facts.base_model:
        known = {repo.lower(): name for repo, name in LICENSES.items()}
        base = "/".join(facts.base_model.split("/")[:2]).lower()
        if base in known:
            return known[base]
    return APACHE if model.config["type"] == "mini" else ""


def run_facts(config: Mapping[str, Any], results: Mapping[str, Any]) -> ModelFacts:
    """Facts from a run of dyfn-train.

    Args:
        config: The settings, as config.yaml has them.
        results: What results.json has; empty for a run that is not over.
    """
    base = str(config.get("base", ""))
    data = config.get("data") or config.get("recordings") or []
    given = {key: value for key, value in config.items() if value is not None}
    told = {name: results[key] for key, name in _TRAINED.items() if key in results}
    scores = {name: value for name, value in results.items() if name not in COUNTERS}
    return ModelFacts(
        base_model=base if is_hub_id(base) and not Path(base).exists() else without_folders(base),
        data=tuple(str(without_folders(one)) for one in data),
        training=without_folders(
            {**{k: v for k, v in given.items() if k not in ("base", "data")}, **told}
        ),
        metrics={k: float(v) for k, v in scores.items() if isinstance(v, int | float)},
    )


def without_folders(value: Any) -> Any:
    """JSON-able values whose paths have lost the folders in front of a file's name."""
    if isinstance(value, str):
        return _FOLDERS.sub("", value)
    if isinstance(value, Mapping):
        return {key: without_folders(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [without_folders(inner) for inner in value]
    return value


def model_card(model: GeometryModel, facts: ModelFacts, repo_id: str = "") -> ModelCard:
    """The card of a model. repo_id: where it is or will be on the Hub; "": not known."""
    from huggingface_hub import ModelCard, ModelCardData

    named = license_of(model, facts)
    base = facts.base_model
    data = ModelCardData(
        license=named or None,
        library_name=LIBRARY,
        pipeline_tag=PIPELINE,
        base_model="/".join(base.split("/")[:2]) if is_hub_id(base) else None,
        tags=["depth", "monocular-depth", "video-depth", "dyfn", f"arxiv:{PAPER}"],
    )
    return ModelCard(f"---\n{data.to_yaml()}\n---\n\n{_text(model, facts, named, repo_id)}")


def _text(model: GeometryModel, facts: ModelFacts, named: str, repo_id: str) -> str:
    return (
        "\n\n".join(
            part
            for part in (
                f"# {repo_id.rpartition('/')[2] or 'A model of dyfn_ros'}",
                _summary(model),
                _use(repo_id or "OWNER/NAME"),
                _table("Model", _model_rows(model, facts, named)),
                _list("Data", facts.data, "What it was trained on is not known."),
                _table("Scores", {name: f"{value:.4g}" for name, value in facts.metrics.items()}),
                _settings(facts.training),
                f"The model's configuration is in `config.json`. Written by `{LIBRARY}`.",
            )
            if part
        )
        + "\n"
    )


def _summary(model: GeometryModel) -> str:
    paper = f"[arXiv {PAPER}](https://arxiv.org/abs/{PAPER})"
    if model.stabilizer is None:
        return "A base model: the depth of each image by itself, without DyFN."
    return (
        "Depth from one moving camera, frame by frame. Dynamic Feature Normalization (DyFN, "
        f"{paper}) keeps its scale from frame to frame."
    )


def _use(repo_id: str) -> str:
    return f"""## Use

    pip install dyfn_ros

```python
from dyfn_core import DepthStream, DyFNModel

model = DyFNModel.from_pretrained("{repo_id}").model
stream = DepthStream(model, camera_matrix=K)  # K: 3 x 3 in pixels, or None
for image in frames:  # H x W x 3 uint8 RGB
    depth = stream.push(image).depth
```"""


def _model_rows(model: GeometryModel, facts: ModelFacts, named: str) -> dict[str, str]:
    stabilizer = model.stabilizer
    own = 0 if stabilizer is None else sum(p.numel() for p in stabilizer.parameters())
    size = sum(p.numel() for p in model.parameters())
    metres = {"": "no", "camera": "of a known camera"}.get(model.knows_metres, "yes")
    return {
        "type": f"`{model.config['type']}`",
        "base model": facts.base_model or "not known",
        "parameters": f"{size / 1e6:.2f}M" + (f", {own / 1e6:.2f}M of them DyFN's" if own else ""),
        "output": _QUANTITIES[model.quantity],
        "metres by itself": metres,
        "licence": named or "not known; that of the base",
    }


def _table(title: str, rows: Mapping[str, str]) -> str:
    if not rows:
        return ""
    lines = [f"| {name} | {value} |" for name, value in rows.items()]
    return "\n".join([f"## {title}", "", "| | |", "| --- | --- |", *lines])


def _list(title: str, entries: tuple[str, ...], otherwise: str) -> str:
    return f"## {title}\n\n" + ("\n".join(f"- {entry}" for entry in entries) or otherwise)


def _settings(training: Mapping[str, Any]) -> str:
    if not training:
        return ""
    text = yaml.safe_dump(dict(training), sort_keys=False, allow_unicode=True).strip()
    return f"## Training\n\n```yaml\n{text}\n```"
