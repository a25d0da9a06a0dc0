"""An egocentric world simulator in JAX."""
