"""Training tasks, each an `update.Task` with networks, examples and a loss.

denoising      diffusion loss of the denoiser on cached latents
autoencoding   reconstruction loss of the video VAE
refining       the same with LPIPS and more weight on motion
"""
