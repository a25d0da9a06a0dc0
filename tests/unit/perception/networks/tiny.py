"""Tiny random checkpoints in the layout of the real ones, written by `save_pretrained`."""

from pathlib import Path


def depth_anything(folder: Path, *, kind: str = "metric") -> Path:
    import torch
    import transformers as hf

    torch.manual_seed(0)
    backbone = hf.Dinov2Config(
        hidden_size=32, num_hidden_layers=4, num_attention_heads=4, image_size=56, patch_size=14,
        mlp_ratio=2, out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = hf.DepthAnythingConfig(
        backbone_config=backbone, patch_size=14, reassemble_hidden_size=32,
        reassemble_factors=[4, 2, 1, 0.5], neck_hidden_sizes=[16, 16, 32, 32],
        fusion_hidden_size=16, head_hidden_size=8, depth_estimation_type=kind, max_depth=20,
    )  # fmt: skip
    network = hf.DepthAnythingForDepthEstimation(config)
    with torch.no_grad():
        for weight in network.head.parameters():
            weight.normal_(
                std=0.2
            )  # initialized as for training, depth would be the same everywhere
    network.save_pretrained(folder)
    hf.DPTImageProcessorPil(
        size={"height": 56, "width": 56}, keep_aspect_ratio=True, ensure_multiple_of=14
    ).save_pretrained(folder)
    return folder
