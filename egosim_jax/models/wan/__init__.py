"""Networks of Wan 2.1 and EgoSim: video transformer, video VAE, umT5 and CLIP's image encoder."""
