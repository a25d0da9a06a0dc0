"""JSON files that make a folder of converted networks a pipeline of diffusers."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from egosim_jax.convert.tables import table_of

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig


def pipeline_files(config: ModelConfig, written: Collection[str]) -> Mapping[str, Any]:
    """Return the JSON files of a pipeline by path; it has the networks `written` to the folder.

    Empty if the denoiser's table describes no pipeline.
    """
    describe = table_of(config.dit).pipeline
    if describe is None:
        return {}
    files = describe(config)
    for name, network in config.networks.items():
        table = table_of(network)
        if table.reference is None:
            continue
        reference = table.reference
        folder = table.namings[reference.naming].folder
        present = name in written
        entry = [reference.library, reference.kind] if present else [None, None]
        files["model_index.json"][folder] = entry
        if present:
            files[f"{folder}/config.json"] = reference.config_json(network)
    return files
