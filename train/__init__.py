"""Sharded training: recipes, tasks, the loop, and the encoding of clips to latents.

Networks belong in `models`, the diffusion objective in `diffusion`, shards and loader in `data`.

    recipes                       `RECIPES` and `get`: named trainings
    recipe                        `Recipe`, their interface
    fine_tuning                   recipe: a denoiser from given weights, all of it or a LoRA
    from_scratch, from_tabletop   recipes: a small model from random weights
    refine_vae                    recipe: the VAE of given weights
    loop                          `train`, the training loop
    update                        `Task`, `TrainState` and one jitted update
    tasks                         networks, examples and loss of each training
    config                        `TrainConfig`, `OptimizerConfig`
    encode, encode_windows        clips to latents shards
    preflight                     compile an update for an absent machine
    monitor, metric_writers       speed, watchdog, skipped updates, sample clips; logs
    distributed                   processes of a run
"""
