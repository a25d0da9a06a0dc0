"""CogVideoX: video transformer, with the inputs of CogVideoX-Fun and DWM, VAE and text encoder."""
