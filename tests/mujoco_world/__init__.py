"""A world in MuJoCo that shares nothing with the tabletop world, as a judge of perception."""
