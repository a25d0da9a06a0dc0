"""Names in files that earlier versions wrote, with the names that this version uses for them.

Run folders of before the renaming are resumed: config.json is compared under today's names, the
kept lines of metrics.jsonl are rewritten, and a checkpoint's arrays are read under their old names.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

METRICS = {
    "rate": "lr",
    "gradient_norm": "grad_norm",
    "seconds": "step_time_s",
    "waiting": "data_wait_frac",
    "gigabytes": "peak_mem_gb",
    "minutes_left": "eta_min",
    "left_out": "skipped_updates",
    "skipped": "skipped_records",
    "squared": "mse",
    "edges": "edge_loss",
}
"""Keys of metrics.jsonl: the old name, then today's."""
STATE = {
    "moments": "opt_state",
    "usual_norm": "grad_norm_ema",
    "left_out": "consecutive_skips",
    "average": "ema_params",
}
"""Fields of the training state in a checkpoint: the old name, then today's."""
TYPES = {
    "Training": "TrainConfig",
    "RealTiny": "FromClips",
    "Tabletop": "FromTabletop",
    "FlowSchedule": "RectifiedFlow",
    "Plan": "DatasetConfig",
}
"""Classes of config.json: the old name, then today's."""
RECIPES = ("RealTiny", "Tabletop")
"""Old names of recipes, which experiments also have."""
FIELDS = {
    "Training": {"accumulate": "grad_accum_steps", "patience": "hang_timeout_s"},
    "OptimizerConfig": {
        "rule": "name",
        "warmup": "warmup_steps",
        "decay": "schedule",
        "clip": "clip_grad_norm",
        "spike": "skip_grad_norm_factor",
        "average": "ema_decay",
    },
    "ModelConfig": {"schedule": "process"},
    "Denoising": {"change": "change_loss_weight"},
    "Autoencoding": {"weights": "stream_probs", "edges": "edge_weight", "kl": "kl_weight"},
    "Tabletop": {"change": "change_loss_weight"},
}
"""Fields of config.json by their class's old name: the old name, then today's."""
_NO_DROPOUT = {"type": "ConditionDropout", "prior": 0.0, "mask": 0.0, "hands": 0.0, "text": 0.0}
_DROPOUT = {"type": "ConditionDropout", "prior": 0.15, "mask": 0.15, "hands": 0.15, "text": 0.15}
ADDED: Mapping[str, Mapping[str, Any]] = {
    "RealTiny": {
        "clips": 0,
        "crop": [48, 64],
        "dropout": _NO_DROPOUT,
        "change_loss_weight": 0.0,
        "weights_dtype": "float32",
    },
    "FlowSchedule": {"prediction": "velocity"},
    "ModelConfig": {
        "layout": {
            "type": "ChannelLayout",
            "parts": [["noisy", 16], ["mask", 4], ["prior", 16], ["hands", 16]],
            "mask_packing": "space",
            "mask_one": "generate",
            "mask_scale": 1.0,
            "mask_prior": True,
        },
    },
    "PromptTokenizer": {"clean": True},
    "DatasetConfig": {"prior": "state", "hands": "skeleton"},
    "Plan": {"prior": "state", "hands": "skeleton"},
    "RefineVAE": {"motion_weight": 0.0, "stream_probs": [0.6, 0.25, 0.15]},
    "Refining": {"motion_weight": 0.0},
    "Tabletop": {
        "crop": [48, 64],
        "dropout": _DROPOUT,
        "stride": 1,
        "weights_dtype": "float16",
        "rollout_clips": 4,
    },
}
"""Fields that a class of config.json once did not have, by its name then, with their values."""
DROPPED = {"Objective": ("schedule",)}
"""Fields of config.json that are gone, because another field always had the same value."""


def upgrade(recorded: Any) -> Any:
    """Return what a config.json holds under today's names."""
    if isinstance(recorded, list):
        return [upgrade(item) for item in recorded]
    if not isinstance(recorded, dict):
        return recorded
    kind = recorded.get("type")
    if kind in RECIPES and "denoiser" not in recorded:  # an experiment of the same name
        kind = None
    if not isinstance(kind, str):
        return {name: upgrade(value) for name, value in recorded.items()}
    renamed, dropped = FIELDS.get(kind, {}), DROPPED.get(kind, ())
    fields = {
        renamed.get(name, name): upgrade(value)
        for name, value in recorded.items()
        if name not in dropped
    }
    if kind == "RealTiny" and _made_its_clips(recorded):
        fields |= {"metadata": None, "clips": 8}
    return {**ADDED.get(kind, {}), **fields, "type": TYPES.get(kind, kind)}


def upgrade_metrics(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return a line of metrics.jsonl under today's names."""
    return {METRICS.get(name, name): value for name, value in line.items()}


def _made_its_clips(recorded: Mapping[str, Any]) -> bool:
    """Return whether a run's metadata is that of the clips in its run folder."""
    return (
        Path(str(recorded.get("metadata"))) == Path(str(recorded.get("out"))) / "clips/metadata.csv"
    )
