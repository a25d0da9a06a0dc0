"""Conversion of weights and LoRAs from and to the checkpoints of PyTorch projects.

Networks belong in `models`, bounded readers of foreign files in `io.untrusted` and `io.mapped`.

    commands      subcommands of `egosim convert`
    detect        the networks of a checkpoint, and their namings
    source        foreign checkpoints: tensors by name, not yet read
    tables        names of each network's weights in other projects
    rules         rules of a table, and their match with a checkpoint
    plan          weights to write, each with functions that compute its pieces
    widen         base models with fewer input channels
    writer        resumable writing in bounded memory
    finite        values that no weight may have
    lora          `read_lora`: LoRA files in every common naming
    lora_export   LoRA files for ComfyUI and diffusers, and DWM's checkpoints
    quantize      weights in 8 bits
    verify        comparison of converted weights, and of one forward with PyTorch's
"""
