"""Online training of a small model: scenes are made while the accelerator trains.

processes ─clips▶ encoder ─latents▶ pool ─batches▶ denoiser
                              └─latents and frames▶ decoder

command   `egosim train tabletop --online`
plan      settings, and the position that checkpoints keep
scenes    clips without end, by seed, the processes that make them, and their queue
latents   latents of clips made beforehand
pool      what the updates draw from, on the accelerator
denoiser  its updates, several in one program
decoder   updates of the decoder of the VAE; its encoder stays, so that latents stay valid
run       the loop, its schedule, logs and weights
"""
