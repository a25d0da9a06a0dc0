"""The renderer: a scene's points and the hands, seen along a camera path.

`reference` is NumPy, `jitted` its twin in JAX; both give the same pictures. Sources: EgoSim,
section 3.2 (rendering of the prior) and the released `render_16fps_aligned.py`; the hands' colors
and sizes are those measured on the published videos.
"""
