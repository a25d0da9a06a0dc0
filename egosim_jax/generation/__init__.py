"""From triplets to clips: conditions, the sampler, decoding, and batches of them."""
