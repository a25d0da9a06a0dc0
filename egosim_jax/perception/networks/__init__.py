"""Networks of perception, each of them in a worker process, so that torch is never imported here.

A module holds one network from both sides: a frozen dataclass of its parameters, which satisfies a
Protocol of `perception.estimates`, and the function `load`, which runs in the worker and may import
torch or jax. `worker` has the processes, `checkpoint` the folders of weights, and `pipeline` the
closed loop's pipeline that is made of networks. A network's `fingerprint` has the SHA-256 of its
files and not their path: a run is resumed when the folder has moved, and refused with other
weights.
"""
