"""Tiny random checkpoints in the layout of the real ones, written by `save_pretrained`."""

import json
from pathlib import Path


def transformers_with_seed():
    """Return the library; `save_pretrained` then writes the same random weights in every run."""
    import torch
    import transformers

    torch.manual_seed(0)
    return transformers


def _normal(parameters, std: float) -> None:
    """Draw weights at random: initialized as for training, a network has one result for all."""
    import torch

    with torch.no_grad():
        for weight in parameters:
            weight.normal_(std=std)


def depth_anything(folder: Path, *, kind: str = "metric") -> Path:
    hf = transformers_with_seed()
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
    _normal(network.head.parameters(), 0.2)
    network.save_pretrained(folder)
    hf.DPTImageProcessorPil(
        size={"height": 56, "width": 56}, keep_aspect_ratio=True, ensure_multiple_of=14
    ).save_pretrained(folder)
    return folder


def depth_pro(folder: Path) -> Path:
    hf = transformers_with_seed()
    image = hf.Dinov2Config(
        hidden_size=16, num_hidden_layers=2, num_attention_heads=2, patch_size=4, image_size=8,
        mlp_ratio=2,
    )  # fmt: skip
    config = hf.DepthProConfig(
        image_model_config=image, patch_model_config=image, fov_model_config=image, patch_size=8,
        fusion_hidden_size=12, intermediate_hook_ids=[1, 0], intermediate_feature_dims=[10, 8],
        scaled_images_ratios=[0.5, 1.0], scaled_images_overlap_ratios=[0.0, 0.2],
        scaled_images_feature_dims=[12, 12], use_fov_model=True, num_fov_head_layers=0,
    )  # fmt: skip
    network = hf.DepthProForDepthEstimation(config)
    _normal(network.head.parameters(), 0.3)
    network.fov_model.head.layers[-1].bias.data.fill_(60.0)
    network.save_pretrained(folder)
    processor = {
        "image_processor_type": "DepthProImageProcessor", "size": {"height": 32, "width": 32},
        "image_mean": [0.5] * 3, "image_std": [0.5] * 3,
    }  # fmt: skip
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    return folder


def bert_tokenizer(folder: Path, words: list[str]):
    import transformers as hf

    names = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", *words]
    tokenizer = hf.BertTokenizer(vocab={name: number for number, name in enumerate(names)})
    tokenizer.save_pretrained(folder)
    return tokenizer


def grounding_dino(folder: Path, words=("red", "cup", "book", "hand", "arm")) -> Path:
    hf = transformers_with_seed()
    config = hf.GroundingDinoConfig(
        d_model=32, encoder_layers=2, decoder_layers=2, encoder_attention_heads=4,
        decoder_attention_heads=4, encoder_ffn_dim=16, decoder_ffn_dim=16, num_queries=5,
        num_feature_levels=4, encoder_n_points=2, decoder_n_points=2, max_text_len=64,
        backbone_config=hf.SwinConfig(
            window_size=7, embed_dim=8, depths=[1] * 4, num_heads=[1] * 4, image_size=98,
            out_indices=[2, 3, 4],
        ),
        text_config={
            "model_type": "bert", "vocab_size": 60, "hidden_size": 8, "num_hidden_layers": 2,
            "num_attention_heads": 2, "intermediate_size": 8, "max_position_embeddings": 64,
        },
    )  # fmt: skip
    hf.GroundingDinoForObjectDetection(config).save_pretrained(folder)
    images = hf.GroundingDinoImageProcessorPil(size={"shortest_edge": 98, "longest_edge": 160})
    tokenizer = bert_tokenizer(folder, list(words))
    hf.GroundingDinoProcessor(images, tokenizer).save_pretrained(folder)
    images.save_pretrained(folder)
    return folder


SIZE, CHANNELS = 128, 128
"""Input size of the tiny trackers; their memory needs at least 128 channels."""


def _hiera(size: int) -> dict:
    return {
        "model_type": "sam2_vision_model", "fpn_hidden_size": CHANNELS,
        "backbone_channel_list": [64, 32, 16, 8], "num_feature_levels": 3,
        "fpn_top_down_levels": [2, 3],
        "backbone_feature_sizes": [[size // k] * 2 for k in (4, 8, 16)],
        "backbone_config": {
            "model_type": "sam2_hiera_det_model", "hidden_size": 8, "num_attention_heads": 1,
            "image_size": [size, size], "blocks_per_stage": [1, 1, 2, 1],
            "embed_dim_per_stage": [8, 16, 32, 64], "num_attention_heads_per_stage": [1, 1, 2, 2],
            "window_size_per_stage": [8, 4, 4, 4], "global_attention_blocks": [3],
            "window_positional_embedding_background_size": [4, 4],
        },
    }  # fmt: skip


def _prompted(size: int, patch: int) -> dict:
    return {
        "prompt_encoder_config": {
            "hidden_size": CHANNELS, "image_size": size, "patch_size": patch,
            "mask_input_channels": 8,
        },
        "mask_decoder_config": {
            "hidden_size": CHANNELS, "mlp_dim": 64, "num_hidden_layers": 2,
            "num_attention_heads": 4, "iou_head_hidden_dim": CHANNELS,
        },
    }  # fmt: skip


def _memory(grid: int) -> dict:
    return {
        "num_maskmem": 3, "memory_attention_hidden_size": CHANNELS,
        "memory_attention_num_layers": 1,
        "memory_attention_rope_feat_sizes": [grid, grid], "memory_encoder_hidden_size": CHANNELS,
        "memory_encoder_output_channels": 64, "mask_downsampler_embed_dim": CHANNELS,
        "memory_fuser_embed_dim": CHANNELS, "memory_fuser_intermediate_dim": 64,
        "memory_fuser_num_layers": 1,
    }  # fmt: skip


def _video_processor(folder: Path, size: int, mean: list[float], std: list[float]) -> None:
    content = {
        "video_processor_type": "Sam2VideoVideoProcessor", "image_mean": mean, "image_std": std,
        "size": {"height": size, "width": size},
    }  # fmt: skip
    (folder / "video_preprocessor_config.json").write_text(json.dumps(content))


IMAGENET = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225])


def edgetam(folder: Path) -> Path:
    """EdgeTAM with SAM 2's vision encoder, because its own encoder RepViT needs another library."""
    hf = transformers_with_seed()
    config = hf.EdgeTamVideoConfig(
        vision_config=_hiera(SIZE), **_prompted(SIZE, 16), **_memory(SIZE // 16), image_size=SIZE,
        memory_attention_rope_k_sizes=[4, 4], memory_attention_mlp_hidden_size=64,
        perceiver_resampler_num_latents=16, perceiver_resampler_num_latents_2d=16,
        perceiver_resampler_num_layers=1,
    )  # fmt: skip
    hf.EdgeTamVideoModel(config).save_pretrained(folder)
    _video_processor(folder, SIZE, *IMAGENET)
    return folder


def sam2(folder: Path) -> Path:
    hf = transformers_with_seed()
    config = hf.Sam2VideoConfig(
        vision_config=_hiera(SIZE), **_prompted(SIZE, 16), **_memory(SIZE // 16), image_size=SIZE,
        memory_attention_feed_forward_hidden_size=64,
    )  # fmt: skip
    hf.Sam2VideoModel(config).save_pretrained(folder)
    _video_processor(folder, SIZE, *IMAGENET)
    return folder


def sam3(folder: Path, *, size: int = 112) -> Path:
    hf = transformers_with_seed()
    grid = size // 14
    vision = {
        "model_type": "sam3_vision_model", "fpn_hidden_size": CHANNELS,
        "scale_factors": [4.0, 2.0, 1.0, 0.5],
        "backbone_feature_sizes": [[4 * grid] * 2, [2 * grid] * 2, [grid] * 2],
        "backbone_config": {
            "model_type": "sam3_vit_model", "hidden_size": 32, "num_hidden_layers": 2,
            "num_attention_heads": 4, "intermediate_size": 64, "image_size": size,
            "patch_size": 14, "window_size": 4, "global_attn_indexes": [0, 1],
        },
    }  # fmt: skip
    tracker = hf.Sam3TrackerVideoConfig(
        vision_config=vision, **_prompted(size, 14), **_memory(grid), image_size=size,
        memory_attention_feed_forward_hidden_size=64,
    )  # fmt: skip
    layers = {"hidden_size": CHANNELS, "num_attention_heads": 4, "intermediate_size": 64}
    detector = hf.Sam3Config(
        vision_config=vision,
        text_config={
            "model_type": "clip_text_model", "vocab_size": 600, "hidden_size": 32,
            "intermediate_size": 64, "projection_dim": 32, "num_hidden_layers": 2,
            "num_attention_heads": 4, "max_position_embeddings": 32, "hidden_act": "gelu",
            "bos_token_id": 512, "eos_token_id": 513,
        },
        geometry_encoder_config={
            **layers, "num_layers": 1, "mask_fuser_hidden_size": CHANNELS,
            "mask_fuser_num_layers": 1,
        },
        detr_encoder_config={**layers, "num_layers": 1},
        detr_decoder_config={**layers, "num_layers": 1, "num_queries": 1},
        mask_decoder_config={"hidden_size": CHANNELS, "num_upsampling_stages": 2},
    )  # fmt: skip
    config = hf.Sam3VideoConfig(
        detector_config=detector, tracker_config=tracker, low_res_mask_size=4 * grid,
        hotstart_delay=2, hotstart_unmatch_thresh=2, hotstart_dup_thresh=2,
        score_threshold_detection=0.0, new_det_thresh=0.0, fill_hole_area=4,
    )  # fmt: skip
    config.image_size = size
    hf.Sam3VideoModel(config).save_pretrained(folder)
    _video_processor(folder, size, [0.5] * 3, [0.5] * 3)
    clip_tokenizer().save_pretrained(folder)
    return folder


def _bytes() -> list[str]:
    """Return the characters of the 256 bytes in byte-level vocabularies."""
    shown = [*range(33, 127), *range(161, 173), *range(174, 256)]
    others = [b for b in range(256) if b not in shown]
    return [chr(b) for b in shown] + [chr(256 + k) for k in range(len(others))]


def clip_tokenizer():
    import transformers as hf

    letters = _bytes()
    words = [*letters, *(c + "</w>" for c in letters), "<|startoftext|>", "<|endoftext|>"]
    vocabulary = {word: number for number, word in enumerate(words)}
    return hf.CLIPTokenizer(vocab=vocabulary, merges=[], model_max_length=32)


def qwen3_vl(folder: Path) -> Path:
    hf = transformers_with_seed()
    tokenizer = hf.Qwen2Tokenizer(
        vocab={letter: number for number, letter in enumerate(_bytes())}, merges=[]
    )
    special = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>",
               "<|vision_end|>", "<|image_pad|>", "<|video_pad|>"]  # fmt: skip
    tokenizer.add_tokens(special, special_tokens=True)
    number = tokenizer.convert_tokens_to_ids
    config = hf.Qwen3VLConfig(
        text_config={
            "vocab_size": len(tokenizer) + 8, "hidden_size": 32, "intermediate_size": 64,
            "num_hidden_layers": 2, "num_attention_heads": 4, "num_key_value_heads": 2,
            "head_dim": 16, "eos_token_id": number("<|im_end|>"),
            "rope_parameters": {
                "rope_type": "default", "rope_theta": 1e4, "mrope_section": [4, 2, 2],
                "mrope_interleaved": True,
            },
        },
        vision_config={
            "depth": 2, "hidden_size": 32, "intermediate_size": 64, "num_heads": 2,
            "out_hidden_size": 32, "patch_size": 16, "spatial_merge_size": 2,
            "temporal_patch_size": 2, "num_position_embeddings": 64,
            "deepstack_visual_indexes": [0, 1],
        },
        image_token_id=number("<|image_pad|>"), video_token_id=number("<|video_pad|>"),
        vision_start_token_id=number("<|vision_start|>"),
        vision_end_token_id=number("<|vision_end|>"),
    )  # fmt: skip
    hf.Qwen3VLForConditionalGeneration(config).save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    hf.Qwen2VLImageProcessorPil(
        patch_size=16, temporal_patch_size=2, merge_size=2, image_mean=[0.5] * 3,
        image_std=[0.5] * 3, size={"shortest_edge": 32 * 32, "longest_edge": 64 * 64},
    ).save_pretrained(folder)  # fmt: skip
    return folder


def video_mae(folder: Path) -> Path:
    hf = transformers_with_seed()
    config = hf.VideoMAEConfig(
        image_size=32, patch_size=8, num_frames=4, tubelet_size=2, hidden_size=24,
        num_hidden_layers=2, num_attention_heads=2, intermediate_size=32,
    )  # fmt: skip
    hf.VideoMAEForVideoClassification(config).save_pretrained(folder)
    processor = {
        "image_mean": [0.5, 0.4, 0.3], "image_std": [0.2, 0.3, 0.25],
        "size": {"shortest_edge": 32}, "crop_size": {"height": 32, "width": 32},
    }  # fmt: skip
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    return folder


def xclip(folder: Path) -> Path:
    hf = transformers_with_seed()
    sizes = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2}
    config = hf.XCLIPConfig(
        text_config={
            **sizes, "num_attention_heads": 2, "vocab_size": 600, "max_position_embeddings": 32,
            "bos_token_id": 512, "eos_token_id": 513,
        },
        vision_config={
            **sizes, "num_attention_heads": 2, "image_size": 32, "patch_size": 8, "num_frames": 4,
            "mit_hidden_size": 16, "mit_intermediate_size": 32, "mit_num_attention_heads": 2,
        },
        projection_dim=16, prompt_num_attention_heads=2,
    )  # fmt: skip
    network = hf.XCLIPModel(config)
    _normal((weight for weight in network.parameters() if weight.ndim > 1), 0.2)
    network.save_pretrained(folder)
    clip_tokenizer().save_pretrained(folder)
    processor = {
        "image_processor_type": "VideoMAEImageProcessor", "do_center_crop": True,
        "image_mean": [0.5, 0.4, 0.3], "image_std": [0.2, 0.3, 0.25],
        "size": {"shortest_edge": 32}, "crop_size": {"height": 32, "width": 32},
    }  # fmt: skip
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    return folder
