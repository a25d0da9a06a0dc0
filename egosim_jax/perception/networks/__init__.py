"""Perception stages with network weights, which may import jax or torch.

Nothing else in perception does. A module here holds the stage of one network, a frozen dataclass as
`pipeline.Stage` describes, and a config that `registry.register` adds by name; `registry` imports
the module when that name is asked for, so that perception without networks imports neither library.
A stage has the path of its weights and their SHA-256 among its fields, checks the file against it
before it loads it, and its method `fingerprint` leaves the path out: a run is resumed when the file
has moved, and refused with other weights.
"""
