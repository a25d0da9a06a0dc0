"""The networks, one file each: pure flax.nnx, no input or output, no mesh."""
